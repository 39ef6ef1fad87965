"""Experiments on the ball that the tests judge and ``python -m pace.studies.ball`` prints (extra ``dev``).

Paddles on paths, drag found back from flights, and the forecast held against the flight.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from pace.config.training import load_train_config
from pace.sim.ball.aero import GRAVITY
from pace.sim.ball.ball import BallParams, BallSim, Forecast, ball_preset

Array = NDArray[np.float64]
CONTROL_DT = 0.02  # s
SUBSTEPS = 2
BALL_DT = load_train_config().engine.ball_dt  # s
TABLE = ball_preset("paper").table
BALLS = ("paper", "standard", "venue", "rubber")  # their flights differ
PRESETS = (*BALLS, "anti_spin", "long_pimples", "short_pimples")  # and the coverings of the paddle
#: m, from the paddle's plane to the centre of a touching ball
REACH = TABLE.paddle_half_thickness + 0.02
NO_AIR = BallParams(0.0027, 0.02, 0.0, 0.0, 0.0, 0.9, 0.0, 0.25, 0.8, 0.0, 0.3)
IN_AIR = BallParams(0.0027, 0.02, 1.225, 0.47, 0.5, 0.9, 0.0, 0.25, 0.8, 0.01, 0.3)


def make_sim(
    num_worlds: int, params: BallParams = NO_AIR, substeps: int = SUBSTEPS, ball_dt: float = BALL_DT
) -> BallSim:
    """Worlds on the CPU, with the table of the presets."""
    return BallSim(num_worlds, "cpu", params, TABLE, CONTROL_DT, substeps, ball_dt)


def put(sim: BallSim, position: object, velocity: object, spin: object = (0.0, 0.0, 0.0)) -> None:
    """Set the balls; rows broadcast over the worlds."""
    for target, value in ((sim.position, position), (sim.velocity, velocity), (sim.spin, spin)):
        target.copy_(torch.as_tensor(np.asarray(value), dtype=torch.float32).expand_as(target))


class Swing:
    """A paddle on a parabola that turns at a constant rate; arrays (N, 3), time 0 is arbitrary."""

    def __init__(
        self, centre: object, normal: object, velocity: object = 0.0, turn: object = 0.0, pull: object = 0.0
    ) -> None:
        vectors = np.broadcast_arrays(*(np.atleast_2d(np.asarray(v, float)) for v in (centre, normal, velocity)))
        self.centre, self.normal, self.velocity = (v + np.zeros((1, 3)) for v in vectors)
        self.turn = np.asarray(turn, float) + np.zeros_like(self.centre)
        self.pull = np.asarray(pull, float) + np.zeros_like(self.centre)

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Centre, normal and velocity of the centre at ``time`` (N,) s."""
        t = time[:, None]
        centre = self.centre + t * self.velocity + 0.5 * t * t * self.pull
        rate = np.linalg.norm(self.turn, axis=1, keepdims=True)
        axis = self.turn / np.maximum(rate, 1e-12)
        along = np.sum(axis * self.normal, axis=1, keepdims=True) * axis
        side = np.cross(axis, self.normal)
        normal = along + np.cos(rate * t) * (self.normal - along) + np.sin(rate * t) * side
        return centre, normal, self.velocity + t * self.pull

    def surface_velocity(self, point: Array, time: Array) -> Array:
        """Velocity of the blade's point at ``point`` (N, 3)."""
        centre, _, velocity = self.at(time)
        return velocity + np.cross(self.turn, point - centre)

    def path(self, start: Array, substeps: int = SUBSTEPS) -> Tensor:
        """The path (N, S + 1, 12) of the control step that begins at ``start`` (N,) s."""
        knots = []
        for knot in range(substeps + 1):
            centre, normal, velocity = self.at(start + knot * CONTROL_DT / substeps)
            knots.append(np.concatenate([centre, normal, velocity, np.broadcast_to(self.turn, centre.shape)], axis=1))
        return torch.tensor(np.stack(knots, axis=1), dtype=torch.float32).contiguous()


def far_path(num_worlds: int, substeps: int = SUBSTEPS) -> Tensor:
    """A paddle out of every ball's way."""
    return Swing(np.full((num_worlds, 3), [0.0, 0.0, 50.0]), [0, 0, 1]).path(np.zeros(num_worlds), substeps)


# --- drag -------------------------------------------------------------------------------------------------------------


def recorded_flights(count: int, frames: int, noise: float) -> Array:
    """Ball positions (frames, count, 3) m of ``paper`` flights before the bounce, 50 a second, with ``noise`` m."""
    rng = np.random.default_rng(4)
    sim = make_sim(count, BallParams.preset("paper"))
    path = far_path(count)
    put(sim, [1.35, 0.0, 1.03], rng.uniform([-6.5, -0.8, 1.5], [-5.0, 0.4, 2.0], (count, 3)))
    seen = [sim.position.numpy().copy()]
    for _ in range(frames - 1):
        sim.fly(path)
        seen.append(sim.position.numpy().copy())
    return np.stack(seen) + rng.normal(0.0, noise, (frames, count, 3))


def _model_flights(k: float, start: Array, frames: int) -> Array:
    """Positions (frames, ...) of flights from ``start`` (2, ..., 3): position and velocity, by fine midpoint steps."""
    position, velocity = start.copy()
    gravity = np.array([0.0, 0.0, -GRAVITY])
    seen = [position.copy()]
    for _ in range(frames - 1):
        for _ in range(4):
            a = gravity - k * np.linalg.norm(velocity, axis=-1, keepdims=True) * velocity
            middle = velocity + 0.0025 * a
            a = gravity - k * np.linalg.norm(middle, axis=-1, keepdims=True) * middle
            position, velocity = position + 0.005 * middle, velocity + 0.005 * a
        seen.append(position.copy())
    return np.stack(seen)


def fitted_drag(flights: Array) -> float:
    """k (1/m) of all flights, with start and velocity of each free: least squares on the positions, as in the paper."""
    frames, count, _ = flights.shape
    launch = np.stack([flights[0], (flights[1] - flights[0]) / CONTROL_DT])

    def residual(parameters: Array) -> Array:
        start = parameters[1:].reshape(2, count, 3)
        return (_model_flights(parameters[0], start, frames) - flights).ravel()

    def jacobian(parameters: Array) -> Array:
        """Flights are independent, so one perturbed run serves the same parameter of all of them."""
        base = residual(parameters)
        out = np.zeros((base.size, parameters.size))
        out[:, 0] = (residual(parameters + 1e-5 * np.eye(1, parameters.size)[0]) - base) / 1e-5
        rows = np.arange(base.size).reshape(frames, count, 3)
        for part in range(2):
            for axis in range(3):
                step = np.zeros((2, count, 3))
                step[part, :, axis] = 1e-5
                change = residual(parameters + np.concatenate([[0.0], step.ravel()])) - base
                for flight in range(count):
                    column = 1 + (part * count + flight) * 3 + axis
                    out[rows[:, flight].ravel(), column] = change[rows[:, flight].ravel()] / 1e-5
        return out

    start = np.concatenate([[0.05], launch.ravel()])
    return float(least_squares(residual, start, jac=jacobian, method="lm").x[0])  # type: ignore[arg-type]


def true_drag(preset: str) -> float:
    """k = rho C_d A / 2 m (1/m) of a preset."""
    ball = ball_preset(preset)
    return 0.5 * ball.air_density * ball.drag_coefficient * np.pi * ball.radius**2 / ball.mass


# --- forecast ---------------------------------------------------------------------------------------------------------


def random_returns(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Position, velocity and spin (N, 3) of balls that leave a paddle: over the net, into it, wide and long."""
    draw = torch.rand(count, 9, generator=torch.Generator().manual_seed(2))
    position = torch.tensor([-1.9, -0.4, 0.85]) + draw[:, :3] * torch.tensor([0.4, 0.8, 0.4])
    velocity = torch.tensor([3.0, -1.2, 0.0]) + draw[:, 3:6] * torch.tensor([5.0, 2.4, 3.5])
    return position, velocity, (draw[:, 6:] - 0.5) * 200.0


def first_contacts(
    position: Tensor, velocity: Tensor, spin: Tensor, params: BallParams, steps: int = 100
) -> dict[str, Tensor]:
    """What ``fly`` makes of the flights: times (N,) s of the first contact with ``own`` half, ``table`` top and
    ``floor``, NaN where there is none, and ``place`` (N, 3) m of the first on the table."""
    sim = make_sim(len(position), params, 1)
    put(sim, position, velocity, spin)
    nan = torch.full((len(position),), torch.nan)
    seen = {"own": nan.clone(), "table": nan.clone(), "floor": nan.clone(), "place": torch.zeros(len(position), 3)}
    path, events = far_path(len(position), 1), sim.events
    for step in range(steps):
        sim.fly(path)
        table = torch.minimum(events.own_bounce_time, events.opponent_bounce_time)
        new = table.isfinite() & seen["table"].isnan()
        seen["place"] = torch.where(new.unsqueeze(1), events.bounce_position, seen["place"])
        for name, time in (("own", events.own_bounce_time), ("table", table), ("floor", events.floor_time)):
            first = time.isfinite() & seen[name].isnan()
            seen[name] = torch.where(first, step * CONTROL_DT + time, seen[name])
    return seen


def forecast_returns(position: Tensor, velocity: Tensor, spin: Tensor, params: BallParams) -> Forecast:
    """The forecast of the same flights."""
    sim = make_sim(len(position), params)
    sim.forecast(torch.ones(len(position), dtype=torch.bool), position, velocity, spin, -1.6)
    return sim.forecast_result


def forecast_errors(preset: str, count: int = 300) -> tuple[Array, Array]:
    """Forecast against flight over random returns that land: errors of the landing's time (s), and of its place (m)
    where that is on the table."""
    start, params = random_returns(count), BallParams.preset(preset)
    ahead, seen = forecast_returns(*start, params), first_contacts(*start, params)
    on_table = ahead.landing_own | ahead.landing_opponent
    time = (ahead.landing_time - torch.where(on_table, seen["table"], seen["floor"])).abs()
    place = (ahead.landing - seen["place"]).norm(dim=1)
    return time[~ahead.landing_time.isnan()].double().numpy(), place[on_table].double().numpy()
