"""Strikes of swinging blades: seen from other frames, and at other phases within a control step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pace.sim.ball.aero import GRAVITY
from pace.sim.ball.ball import BallSim
from pace.studies import ball_reference as reference
from pace.studies.ball_trials import CONTROL_DT, IN_AIR, REACH, Array, Swing, make_sim, put


@dataclass(frozen=True)
class Meetings:
    """Balls that meet swinging, turning blades at time 0: arrays (N, 3), of the ball before the strike."""

    swing: Swing
    contact: Array  # m, centre of the touching ball
    velocity: Array  # m/s
    spin: Array  # rad/s

    def repeated(self, times: int) -> Meetings:
        """Each meeting ``times`` times in a row."""
        old = self.swing
        parts = (old.centre, old.normal, old.velocity, old.turn, old.pull)
        swing = Swing(*(np.repeat(part, times, axis=0) for part in parts))
        return Meetings(swing, *(np.repeat(part, times, axis=0) for part in (self.contact, self.velocity, self.spin)))


def random_meetings(count: int, seed: int = 5) -> Meetings:
    """Blades at up to 7 m/s, 14 rad/s and 70 m/s^2, struck on their faces at 2 to 12 m/s along the normal."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    across = np.cross(normal, rng.normal(size=(count, 3)))
    across *= 0.07 * rng.random((count, 1)) / np.linalg.norm(across, axis=1, keepdims=True)
    centre = np.array([0.0, 0.0, 3.0]) + rng.uniform(-0.3, 0.3, (count, 3))
    swing = Swing(
        centre, normal, rng.uniform(-4, 4, (count, 3)), rng.uniform(-8, 8, (count, 3)), rng.uniform(-40, 40, (count, 3))
    )
    contact = centre + across + REACH * normal
    slant = rng.uniform(-3, 3, (count, 3))
    slant -= np.sum(slant * normal, axis=1, keepdims=True) * normal
    own = swing.surface_velocity(contact - 0.02 * normal, np.zeros(count))
    velocity = own + slant - rng.uniform(2, 12, (count, 1)) * normal
    return Meetings(swing, contact, velocity, rng.uniform(-150, 150, (count, 3)))


def random_strikes(count: int, seed: int = 5) -> tuple[BallSim, Meetings, Array]:
    """Balls without air, launched so that they meet their blades within the first control step, which begins at the
    returned times (N,), -18 to -2 ms."""
    meetings = random_meetings(count, seed)
    start = -np.random.default_rng(seed + 1).uniform(0.002, 0.018, count)
    t, gravity = start[:, None], np.array([0.0, 0.0, -GRAVITY])
    sim = make_sim(count)
    position = meetings.contact + meetings.velocity * t + 0.5 * gravity * t**2
    put(sim, position, meetings.velocity + gravity * t, meetings.spin)
    return sim, meetings, start


STRIKES = 1000  # seen from each frame


def _struck(frame_velocity: Array, yaw: float) -> tuple[Array, Array]:
    """Velocity (turned back, seen from the moving frame) and spin after the same strikes in another frame."""
    sim, meetings, start = random_strikes(STRIKES)
    swing = meetings.swing
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    swing = Swing(
        swing.centre @ turn.T,
        swing.normal @ turn.T,
        swing.velocity @ turn.T + frame_velocity,
        swing.turn @ turn.T,
        swing.pull @ turn.T,
    )
    position, velocity, spin = (a.numpy() @ turn.T for a in (sim.position, sim.velocity, sim.spin))
    put(sim, position + start[:, None] * frame_velocity, velocity + frame_velocity, spin)
    sim.fly(swing.path(start))
    if not bool((sim.events.paddle_hit >= 1).all()):
        raise RuntimeError("a strike of the frame experiment was missed")
    return (sim.events.hit_velocity_out.numpy() - frame_velocity) @ turn, sim.events.hit_spin_out.numpy() @ turn


def frame_difference(frame_velocity: tuple[float, float, float], yaw: float) -> tuple[float, float]:
    """STRIKES strikes seen from a frame that moves at ``frame_velocity`` m/s and is turned by ``yaw`` rad.

    Returns the largest difference of the velocity after it, as a share of the speed, and of the spin (rad/s).
    """
    home, home_spin = _struck(np.zeros(3), 0.0)
    moved, moved_spin = _struck(np.array(frame_velocity), yaw)
    speed = np.linalg.norm(home, axis=1, keepdims=True)
    return float(np.max(np.abs(moved - home) / speed)), float(np.max(np.abs(moved_spin - home_spin)))


def phase_spread(substeps: int, strikes: int = 100, phases: int = 20) -> tuple[Array, Array]:
    """Strikes in air, each on ``phases`` instants of a control step, the path known every 20 / substeps ms.

    Returns the spread of the velocity after each strike (strikes,), as a share of its speed, and of its spin (rad/s).
    """
    count = strikes * phases
    meetings = random_meetings(strikes).repeated(phases)
    values = (IN_AIR.mass, 0.02, 1.225, 0.47, 0.5, 0.9, 0.0, 0.25, 0.0, 0.0, 0.0)
    ball = reference.ReferenceBall(*(np.full(count, v) for v in values))
    start = -np.tile(np.linspace(0.0, CONTROL_DT, phases, endpoint=False) + 5e-4, strikes)
    sim = make_sim(count, IN_AIR, substeps)
    put(sim, *reference.fly_for(ball, meetings.contact, meetings.velocity, meetings.spin, start), meetings.spin)
    out, out_spin, hit = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, bool)
    for step in range(2):
        sim.fly(meetings.swing.path(start + step * CONTROL_DT, substeps))
        new = (sim.events.paddle_hit.numpy() > 0) & ~hit
        out[new], out_spin[new] = sim.events.hit_velocity_out.numpy()[new], sim.events.hit_spin_out.numpy()[new]
        hit |= new
    if not hit.all():
        raise RuntimeError("a strike of the phase experiment was missed")
    out, out_spin = out.reshape(strikes, phases, 3), out_spin.reshape(strikes, phases, 3)
    speed = np.linalg.norm(out, axis=2).mean(axis=1)
    return np.ptp(out, axis=1).max(axis=1) / speed, np.ptp(out_spin, axis=1).max(axis=1)
