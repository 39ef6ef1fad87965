"""Paddle reaction: the effect of the ball's impulse on the arm, and of the paddle's finite mass on the ball."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from pace.runs.metrics import markdown
from pace.sim.worlds import Worlds
from pace.studies.common import COLOURS, Array, smooth_swings, standing_worlds, study_config
from pace.studies.throws import throw

SPEEDS = (4.0, 6.0, 8.0, 10.0, 12.0)  # m/s, ball against blade along the normal
SWING_STEPS = 20  # control steps before the strike
FOLLOW_STEPS = 10  # after it
SEED = 3


@dataclass(frozen=True)
class Strikes:
    """M strikes: arrays (M,) and, over the control steps that follow, (T, M)."""

    speed: Array  # m/s relative along the normal, requested
    impulse: Array  # N s, along the normal
    paddle_speed: Array  # m/s along the normal, of the struck point before the strike
    ball_speed: Array  # m/s after the strike
    effective_mass: Array  # kg of the paddle at the struck point along the normal, with arm and floating base
    give: Array  # m/s, yield speed of the struck point along the normal, a control step after the strike
    velocity_change: Array  # (T, M) m/s, paddle's centre with reaction minus without
    displacement: Array  # (T, M) m, likewise
    ball_mass: float  # kg

    @property
    def ball_change(self) -> Array:
        """m/s (M,) that a paddle of ``effective_mass`` would take from the ball's speed after the strike."""
        share = self.ball_mass / (self.ball_mass + self.effective_mass)
        return share * self.impulse / self.ball_mass


def strike_all(worlds_each: int, gains: float = 1.0) -> Strikes:
    """``worlds_each`` strikes at each of SPEEDS, in the middle of random swings, on the native engine.

    ``gains`` scales kp and kd of all joints from the strike on; at 0 the joints have no dry friction either.
    """
    count = worlds_each * len(SPEEDS)
    speed = torch.tensor(SPEEDS).repeat_interleave(worlds_each)
    both = [_play(count, speed, reaction, gains) for reaction in (True, False)]
    (paddle, worlds, struck), (without, _, _) = both
    change = paddle - without
    turned = torch.linalg.cross(change[0, :, 9:], struck["arm"])
    masses = _effective_masses(worlds, struck)
    return Strikes(
        speed=speed.double().numpy(),
        impulse=struck["impulse"].double().numpy(),
        paddle_speed=struck["paddle_speed"].double().numpy(),
        ball_speed=struck["ball_speed"].double().numpy(),
        effective_mass=masses,
        give=-((change[0, :, 6:9] + turned) * struck["normal"]).sum(1).double().numpy(),
        velocity_change=change[:, :, 6:9].norm(dim=2).double().numpy(),
        displacement=change[:, :, :3].norm(dim=2).double().numpy(),
        ball_mass=worlds.config.ball.mass,
    )


def _play(count: int, speed: Tensor, reaction: bool, gains: float) -> tuple[Tensor, Worlds, dict[str, Tensor]]:
    """Swing, strike, follow through: paddle (T, N, 12) after the strike, the worlds, and the strike."""
    config = study_config(paddle_reaction=reaction)
    if gains == 0.0:
        groups = [dataclasses.replace(group, friction=0.0) for group in config.robot.joint_groups]
        config = dataclasses.replace(config, robot=dataclasses.replace(config.robot, joint_groups=groups))
    worlds = standing_worlds(config, count)
    targets = smooth_swings(worlds.nominal, count, SWING_STEPS + FOLLOW_STEPS + 1, SEED, arm=0.6, rest=0.02)
    for step in range(SWING_STEPS):
        worlds.step(targets[step])
    everyone, no_spin = torch.ones(count, dtype=torch.bool), torch.zeros(count, 3)
    worlds.serve(everyone, *throw(worlds, speed), no_spin)
    start = worlds.engine.qpos_path[:, -1].clone()
    worlds.step(targets[SWING_STEPS])
    events = worlds.ball.events
    if not bool((events.paddle_hit == 1).all()):
        raise RuntimeError("a ball of the reaction study missed its paddle")
    normal = events.hit_normal.clone()
    surface = events.hit_velocity_in - events.hit_relative_velocity
    struck = {
        "qpos": start,
        "normal": normal,
        "arm": (events.hit_offset + events.hit_point - events.hit_position).clone(),
        "impulse": -(events.paddle_impulse * normal).sum(1),
        "paddle_speed": (surface * normal).sum(1),
        "ball_speed": events.hit_velocity_out.norm(dim=1).clone(),
    }
    for scale in (worlds.engine.params.kp_scale, worlds.engine.params.kd_scale):
        scale.fill_(gains)
    worlds.engine.apply_params(torch.ones(count, dtype=torch.bool))
    path = []
    for step in range(FOLLOW_STEPS):
        worlds.serve(torch.ones(count, dtype=torch.bool), *_out_of_the_way(count))
        worlds.step(targets[SWING_STEPS + 1 + step])
        path.append(worlds.kinematics.paddle_path[:, -1].clone())
    return torch.stack(path), worlds, struck


def _out_of_the_way(count: int) -> tuple[Tensor, Tensor, Tensor]:
    still = torch.zeros(count, 3)
    return still + torch.tensor([0.0, 0.0, 50.0]), still, still


def _effective_masses(worlds: Worlds, struck: dict[str, Tensor]) -> Array:
    """1 / (n J M^-1 J' n) (kg) of the struck points, from MuJoCo's own inertia matrix and Jacobian."""
    model, found = worlds.model, []
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    site, jacobian = model.site("paddle"), np.zeros((3, model.nv))
    for qpos, normal, arm in zip(*(struck[key].double().numpy() for key in ("qpos", "normal", "arm")), strict=True):
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        mujoco.mj_jac(model, data, jacobian, None, data.site_xpos[site.id] + arm, int(site.bodyid[0]))
        along = normal @ jacobian
        found.append(1.0 / (along @ np.linalg.solve(inertia, along)))
    return np.array(found)


def cost(num_worlds: int = 1024, repeats: int = 200) -> float:
    """Least time (s) that the reaction adds to a control step of ``num_worlds`` worlds."""
    config = study_config(paddle_reaction=True)
    worlds = standing_worlds(config, num_worlds)
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        worlds._react()
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def table(strikes: Strikes) -> str:
    """A row for each speed: medians over its strikes."""
    header = (
        "ball against blade (m/s)",
        "ball's speed after (m/s)",
        "impulse (mN s)",
        "mass behind the blade (kg)",
        "paddle's velocity changes by (m/s), 20 ms after",
        "largest",
        "paddle is off by at most (mm; 95 % of strikes)",
        "a blade of that mass would take from the ball (m/s)",
        "(%)",
    )
    rows = []
    for speed in SPEEDS:
        chosen = strikes.speed == speed
        taken, after = np.median(strikes.ball_change[chosen]), np.median(strikes.ball_speed[chosen])
        off = 1e3 * strikes.displacement[:, chosen].max(axis=0)
        values = (
            np.median(strikes.velocity_change[0, chosen]),
            np.median(strikes.velocity_change[:, chosen].max(axis=0)),
        )
        rows.append(
            (
                f"{speed:g}",
                f"{after:.1f}",
                f"{1e3 * np.median(strikes.impulse[chosen]):.0f}",
                f"{np.median(strikes.effective_mass[chosen]):.2f}",
                *(f"{value:.3f}" for value in values),
                f"{np.median(off):.1f} ({np.quantile(off, 0.95):.1f})",
                f"{taken:.2f}",
                f"{100 * taken / after:.1f}",
            )
        )
    return markdown(header, rows)


def draw(strikes: Strikes, figure: Figure) -> None:
    """Left: change of the paddle's velocity after the strike; right: change of its position."""
    elapsed = 20.0 * np.arange(1, FOLLOW_STEPS + 1)  # ms; the impulse is distributed over the first control step
    for axes, values, label, scale in zip(
        figure.subplots(1, 2),
        (strikes.velocity_change, strikes.displacement),
        ("change of the paddle's velocity (m/s)", "change of its position (mm)"),
        (1.0, 1e3),
        strict=True,
    ):
        for speed, colour in zip(SPEEDS, COLOURS, strict=False):
            chosen = scale * values[:, strikes.speed == speed]
            axes.plot(elapsed, np.median(chosen, axis=1), "o-", color=colour, lw=1.5, ms=3, label=f"{speed:g} m/s")
            low, high = np.quantile(chosen, (0.25, 0.75), axis=1)
            axes.fill_between(elapsed, low, high, color=colour, alpha=0.15, lw=0)
        axes.set(xlabel="time since the control step of the strike (ms)", ylabel=label, ylim=(0, None))
    figure.axes[0].legend(frameon=False, fontsize=8, title="ball against blade", title_fontsize=8)
