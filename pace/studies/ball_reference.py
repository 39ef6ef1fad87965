"""Independent reference solutions for the ball's kernels: NumPy in double precision, SciPy (extra ``dev``).

This module shares no code with the kernels, only the tables of ``configs/ball``. A batch of flights is one system of
equations for DOP853 at 1e-8. The time of each flight is scaled to [0, 1], and an event is found by Newton's method on
its duration, without interpolation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from pace.config.ball import AirConfig
from pace.sim.ball.ball import ball_preset

T = TypeVar("T")
Array = NDArray[np.float64]
#: Value and rate of an event's function, from position and velocity (N, 3).
Condition = Callable[[Array, Array], tuple[Array, Array]]

GRAVITY = np.array([0.0, 0.0, -9.81])
TOLERANCE = 1.0e-8  # relative and absolute; the bends of the tables make a smaller one costly


@dataclass(frozen=True)
class ReferenceBall:
    """Parameters of N balls, arrays (N,); names as in :class:`pace.sim.ball.BallParams`."""

    mass: Array
    radius: Array
    air_density: Array
    drag_coefficient: Array
    magnus_coefficient: Array
    table_restitution: Array
    table_restitution_slope: Array
    table_friction: Array
    table_drag: Array
    table_lift: Array
    table_tangential_restitution: Array

    def acceleration(self, velocity: Array, spin: Array) -> Array:
        """(N, 3) m/s^2 from the forces -1/2 rho C_d A |v| v and (1/2 rho A r C_m + rho V C_M) (omega x v)."""
        pressure = 0.5 * self.air_density * np.pi * self.radius**2
        speed, turning = np.linalg.norm(velocity, axis=1), np.linalg.norm(spin, axis=1)
        ratio = self.radius * turning / np.maximum(speed, 1.0e-3)
        drag_coefficient = self.drag_coefficient + self.table_drag * measured_drag(speed, ratio)
        volume = 4.0 / 3.0 * np.pi * self.radius**3
        lift_factor = pressure * self.radius * self.magnus_coefficient
        lift_factor = lift_factor + self.air_density * volume * self.table_lift * measured_lift(speed, turning)
        drag = -(pressure * drag_coefficient * speed)[:, None] * velocity
        return GRAVITY + (drag + lift_factor[:, None] * np.cross(spin, velocity)) / self.mass[:, None]


def measured_drag(speed: Array, ratio: Array) -> Array:
    """C_d of ``configs/ball/_air.yaml`` (N,): linear in both, held below the rows, extrapolated above them."""
    rows = _air().drag
    by_row = np.stack([np.interp(ratio, row.ratio, row.coefficient) for row in rows])
    found = _between([row.speed for row in rows], by_row, speed)
    beyond = np.maximum(speed - rows[-1].speed, 0.0) / (rows[-1].speed - rows[-2].speed)
    return np.maximum(found + beyond * (by_row[-1] - by_row[-2]), 0.0)


def measured_lift(speed: Array, turning: Array) -> Array:
    """C_M of ``configs/ball/_air.yaml`` (N,): linear in speed, held beyond the rows."""
    rows = _air().lift
    by_row = [
        np.where(
            turning <= row.bend,
            row.slope * turning + row.offset,
            np.polyval([row.quadratic, row.linear, row.constant], turning),
        )
        for row in rows
    ]
    return _between([row.speed for row in rows], np.maximum(by_row, 0.0), speed)


def _between(speeds: list[float], by_row: Array, speed: Array) -> Array:
    """Each column of ``by_row`` (rows, N) at its ``speed`` (N,), by interpolation."""
    known, every = np.array(speeds), np.arange(len(speed))
    above = np.clip(np.searchsorted(known, speed), 1, len(known) - 1)
    share = np.clip((speed - known[above - 1]) / (known[above] - known[above - 1]), 0.0, 1.0)
    return (1.0 - share) * by_row[above - 1, every] + share * by_row[above, every]


@lru_cache(maxsize=1)
def _air() -> AirConfig:
    air = ball_preset("rubber").air
    assert air is not None
    return air


def fly_for(ball: ReferenceBall, position: Array, velocity: Array, spin: Array, duration: Array) -> tuple[Array, Array]:
    """Position and velocity (N, 3) after ``duration`` (N,) s of free flight."""
    shape = (2, len(position), 3)

    def rate(_tau: float, state: Array) -> Array:
        velocity = state.reshape(shape)[1]
        both = np.stack([velocity, ball.acceleration(velocity, spin)])
        return (both * duration[:, None]).ravel()

    start = np.stack([position, velocity]).ravel()
    solution = solve_ivp(rate, (0.0, 1.0), start, method="DOP853", rtol=TOLERANCE, atol=TOLERANCE)
    end = solution.y[:, -1].reshape(shape)
    return end[0], end[1]


def fly_until(
    ball: ReferenceBall, position: Array, velocity: Array, spin: Array, condition: Condition, guess: Array
) -> tuple[Array, Array, Array]:
    """Duration (N,), position and velocity (N, 3) at the zero of ``condition``, by Newton's method from ``guess`` s."""
    duration = guess.copy()
    for _ in range(20):
        end_position, end_velocity = fly_for(ball, position, velocity, spin, duration)
        value, rate = condition(end_position, end_velocity)
        duration = duration - value / rate
        if np.abs(value / rate).max() < 1.0e-6:
            return duration, *fly_for(ball, position, velocity, spin, duration)
    raise RuntimeError("an event of a reference flight was not found in 20 Newton steps")


def rebound(
    velocity: Array,
    spin: Array,
    normal: Array,
    surface: Array,
    radius: Array,
    restitution: Array,
    friction: Array,
    tangential: Array | float = 0.0,
) -> tuple[Array, Array]:
    """Velocity and spin (N, 3) of approaching hollow spheres after an impulse, from the balance of momentum.

    Per unit of mass: the normal impulse reverses the approach with ``restitution``; the friction impulse reverses the
    slip of the contact with ``tangential``, and is at most ``friction`` times the normal impulse.
    """
    inertia = 2.0 / 3.0 * radius**2
    arm = -radius[:, None] * normal
    relative = velocity - surface + np.cross(spin, arm)
    approach = -np.sum(relative * normal, axis=1)
    slip = relative + approach[:, None] * normal
    slip_speed = np.linalg.norm(slip, axis=1)
    push = (1.0 + restitution) * approach
    stopping = (1.0 + tangential) * slip_speed / (1.0 + radius**2 / inertia)
    grip = np.minimum(stopping, friction * push)
    direction = -slip / np.maximum(slip_speed, 1.0e-300)[:, None]
    impulse: Array = push[:, None] * normal + grip[:, None] * direction
    return velocity + impulse, spin + np.cross(arm, impulse) / inertia[:, None]


@dataclass(frozen=True)
class ReferenceServe:
    """A serve up to its apex after one bounce on the table's top, taken as an infinite plane; (N, ...) arrays."""

    bounce_time: Array  # s
    bounce: Array  # m, centre
    bounce_velocity: Array  # m/s, after
    apex_time: Array  # s
    apex: Array  # m


def fly_serve(
    ball: ReferenceBall, position: Array, velocity: Array, spin: Array, table_height: float
) -> ReferenceServe:
    """Fly serves to the apex after their bounce on the table."""
    height = position[:, 2] - table_height - ball.radius
    rise = velocity[:, 2]
    ballistic = (rise + np.sqrt(rise**2 - 2.0 * GRAVITY[2] * height)) / -GRAVITY[2]

    def on_table(position: Array, velocity: Array) -> tuple[Array, Array]:
        return position[:, 2] - table_height - ball.radius, velocity[:, 2]

    bounce_time, bounce, arriving = fly_until(ball, position, velocity, spin, on_table, ballistic)
    up = np.tile([0.0, 0.0, 1.0], (len(position), 1))
    restitution = ball.table_restitution + ball.table_restitution_slope * arriving[:, 2]
    contact = (ball.radius, restitution, ball.table_friction, ball.table_tangential_restitution)
    after, after_spin = rebound(arriving, spin, up, np.zeros_like(up), *contact)

    def level(_position: Array, velocity: Array) -> tuple[Array, Array]:
        return velocity[:, 2], ball.acceleration(velocity, after_spin)[:, 2]

    rise_time, apex, _ = fly_until(ball, bounce, after, after_spin, level, after[:, 2] / -GRAVITY[2])
    return ReferenceServe(bounce_time, bounce, after, bounce_time + rise_time, apex)


@dataclass(frozen=True)
class ServeBatch:
    """Random serves with random parameters, and their reference flights; row i of all arrays is one serve."""

    ball: ReferenceBall
    position: Array
    velocity: Array
    spin: Array
    flight: ReferenceServe


def _rows(table: T, chosen: NDArray[np.intp]) -> T:
    """The ``chosen`` rows of a dataclass of arrays."""
    columns = {f.name: getattr(table, f.name)[chosen] for f in fields(table)}  # type: ignore[arg-type]
    return type(table)(**columns)


def _single(values: Array) -> Array:
    """The values, exact in float32."""
    return values.astype(np.float32).astype(np.float64)


def _random_ball(uniform: Callable[..., Array]) -> ReferenceBall:
    """Parameters wider than all presets: of the air constant coefficients, the measured ones, and anything between."""
    drag, lift = uniform(0.0, 1.0), uniform(0.0, 1.0)
    return ReferenceBall(
        mass=uniform(0.0025, 0.0037),
        radius=uniform(0.019, 0.021),
        air_density=uniform(1.0, 1.3),
        drag_coefficient=_single((1.0 - drag) * uniform(0.35, 0.6)),
        magnus_coefficient=_single((1.0 - lift) * uniform(0.0, 1.0)),
        table_restitution=uniform(0.85, 0.98),
        table_restitution_slope=uniform(0.0, 0.02),
        table_friction=uniform(0.05, 0.5),
        table_drag=drag,
        table_lift=lift,
        table_tangential_restitution=uniform(-0.2, 0.8),
    )


@lru_cache(maxsize=4)
def random_serves(count: int, seed: int = 0) -> ServeBatch:
    """``count`` serves over the net that bounce well inside the own half of a 2.74 x 1.525 m table, 0.76 m high.

    Spin up to 150 rad/s on each axis, and each serve its own parameters. Inputs are exact in float32.
    """
    rng = np.random.default_rng(seed)
    samples = count + count // 2 + 10

    def uniform(low: float, high: float, *shape: int) -> Array:
        return _single(rng.uniform(low, high, (samples, *shape)))

    ball = _random_ball(uniform)
    position = np.stack([uniform(1.2, 1.5), uniform(-0.2, 0.2), uniform(0.95, 1.15)], axis=1)
    velocity = np.stack([uniform(-6.5, -4.5), uniform(-0.8, 0.4), uniform(1.3, 2.2)], axis=1)
    spin = uniform(-150.0, 150.0, 3)
    flight = fly_serve(ball, position, velocity, spin, 0.76)

    def at_net(position: Array, velocity: Array) -> tuple[Array, Array]:
        return position[:, 0], velocity[:, 0]

    _, crossing, _ = fly_until(ball, position, velocity, spin, at_net, position[:, 0] / -velocity[:, 0])
    inside = (flight.bounce[:, 0] < -0.05) & (flight.bounce[:, 0] > -1.35) & (np.abs(flight.bounce[:, 1]) < 0.75)
    chosen = np.flatnonzero(inside & (crossing[:, 2] > 0.9125 + 0.04))[:count]
    if len(chosen) < count:
        raise RuntimeError(f"only {len(chosen)} of {samples} random serves are usable, {count} were requested")
    return ServeBatch(_rows(ball, chosen), position[chosen], velocity[chosen], spin[chosen], _rows(flight, chosen))
