"""The predictor's priors for the serves of a task, transferred from the serves that they were measured on.

The defaults of :class:`pace.config.predictor.PredictorPriors` were measured on :data:`MEASURED_ON`. For other serves,
the flight model of :mod:`pace.predictor.filter` shifts each mean by its change for the middle of the ranges, and scales
each standard deviation by the change of its range over the corners of the ranges. For serves with limits, the launches
that keep them stand for the ranges, and the standard deviation of their flights is added in quadrature. For the
measured serves the priors equal the defaults, to the last digit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import product

import torch
from torch import Tensor

from pace.config.base import Range
from pace.config.predictor import FRAME_DT, FlightFit, PredictorConfig, PredictorPriors, Prior
from pace.config.task import TaskConfig
from pace.predictor.filter import Parabola, rebound, time_to_table

NO_WIDTH = 1e-6  # smaller widths are rounding errors
GRID = 5  # values of each quantity
LEAST_SHARE = 0.5  # of a measured standard deviation: balls, tables and noise differ even for the same serve


@dataclass(frozen=True)
class Launches:
    """Ranges of serves, m and m/s, the step between sensed positions, s, and the x of the paddle's target, m."""

    position: tuple[Range, Range, Range]
    velocity: tuple[Range, Range, Range]
    control_dt: float
    target_x: float
    limits: dict[str, Range] = field(default_factory=dict)  # of the serves that are accepted

    @classmethod
    def of(cls, config: TaskConfig) -> Launches:
        """Those of a task."""
        serve = config.serve
        position, velocity = (serve.x, serve.y, serve.z), (serve.vx, serve.vy, serve.vz)
        return cls(position, velocity, config.robot.control_dt, config.reward.target_x, serve.limits())


#: The released training serves (configs/serve/train.yaml when the priors were measured), and reward.target_x.
MEASURED_ON = Launches(
    ([1.35, 1.35], [-0.1, 0.1], [1.03, 1.03]), ([-6.5, -5.0], [-0.8, 0.4], [1.5, 2.0]), FRAME_DT, -1.6
)


def resolve_priors(config: TaskConfig, learned: PredictorPriors | None = None) -> PredictorConfig:
    """The predictor's configuration with priors: the given ones, those of ``learned`` weights, or the serve's."""
    found = config.predictor.priors or learned or derive_priors(Launches.of(config), config.predictor.fit)
    return replace(config.predictor, priors=found)


def derive_priors(launches: Launches, fit: FlightFit) -> PredictorPriors:
    """Priors for these serves."""
    measured = PredictorPriors()
    middle, corners = _accepted(launches, fit) if launches.limits else _middle_and_corners(launches)
    here, there = _flights(middle, launches, fit), _flights(_middle_and_corners(MEASURED_ON)[0], MEASURED_ON, fit)
    reach = _flights(corners, launches, fit), _flights(_middle_and_corners(MEASURED_ON)[1], MEASURED_ON, fit)
    found: dict[str, Prior] = {}
    for name in here:
        prior: Prior = getattr(measured, name)
        moved = (here[name] - there[name])[0].tolist()
        mean = [a + b for a, b in zip(prior.mean, moved, strict=True)]
        widen = _widened if launches.limits else _scaled
        found[name] = Prior(mean, widen(prior.std, *(flights[name] for flights in reach)))
    return replace(measured, **found)


def _scaled(std: list[float], here: Tensor, there: Tensor) -> list[float]:
    """``std`` times the change of the range, from that of ``there`` (M, C) to that of ``here`` (M', C)."""
    wide, known = ((flights.amax(0) - flights.amin(0)).tolist() for flights in (here, there))
    shares = [max(a / b, LEAST_SHARE) if b > NO_WIDTH else 1.0 for a, b in zip(wide, known, strict=True)]
    return [a * b for a, b in zip(std, shares, strict=True)]


def _widened(std: list[float], here: Tensor, _: Tensor) -> list[float]:
    """``std`` and that of ``here`` (M, C), added in quadrature: a scale would be huge for what hardly varied before."""
    return [math.hypot(a, b) for a, b in zip(std, here.std(0).tolist(), strict=True)]


def _middle_and_corners(launches: Launches) -> tuple[Tensor, Tensor]:
    """Positions and velocities (1, 6) in the middle of the ranges, and (64, 6) at all their ends."""
    ranges = (*launches.position, *launches.velocity)
    middle = torch.tensor([[0.5 * (low + high) for low, high in ranges]], dtype=torch.float64)
    return middle, torch.tensor(list(product(*ranges)), dtype=torch.float64)


def _accepted(launches: Launches, fit: FlightFit) -> tuple[Tensor, Tensor]:
    """Mean (1, 6) and all (M, 6) of a grid of launches in the ranges whose flights keep the limits.

    The middle and the corners of the ranges do not stand for serves of which most are resampled. If the flight model
    accepts none, it is those after all.
    """
    ranges = (*launches.position, *launches.velocity)
    axes = [torch.linspace(low, high, GRID if high > low else 1, dtype=torch.float64) for low, high in ranges]
    grid = torch.cartesian_prod(*axes)
    bounce = _flights(grid, launches, fit)["bounce"]
    limited = {"speed": grid[:, 3:].norm(dim=1), "bounce_x": bounce[:, 0], "bounce_y": bounce[:, 1]}
    kept = torch.ones(len(grid), dtype=torch.bool)
    for name, (low, high) in launches.limits.items():
        kept &= (limited[name] >= low) & (limited[name] <= high)
    found = grid[kept]
    return (found.mean(0, keepdim=True), found) if len(found) else _middle_and_corners(launches)


def _flights(launch: Tensor, launches: Launches, fit: FlightFit) -> dict[str, Tensor]:
    """Quantities of the flights of ``launch`` (N, 6), by the name of the prior, (N, 3) or (N, 1)."""
    measured, velocity = PredictorPriors(), launch[:, 3:]
    fall = _slowed(velocity, measured.fall, measured.launch_velocity)
    before = Parabola(launch[:, :3], velocity, fall)
    bounce_time = time_to_table(before, fit)
    bounce = before.at(bounce_time)
    rebounding = rebound(bounce.velocity, fit)
    rise = _slowed(rebounding, measured.rise, measured.rise_velocity)
    after = Parabola(bounce.position, rebounding, rise)
    rise_time = rebounding[:, 2:] / after.gravity(fit.least_gravity)
    apex = after.at(rise_time).position
    target = torch.cat([torch.full_like(apex[:, :1], launches.target_x), apex[:, 1:]], dim=1)
    level = torch.tensor([1.0, 1.0, 0.0])  # a serve falls as far as it rises
    step = 0.5 * launches.control_dt * (velocity + rebounding) * level
    return {
        "launch_velocity": velocity,
        "fall": fall,
        "rise": rise,
        "fall_velocity": 0.5 * (velocity + bounce.velocity),
        "rise_velocity": rebounding,
        "bounce": bounce.position,
        "step": step,
        "age": 0.5 * (bounce_time + rise_time),
        "count": 0.5 * (bounce_time + rise_time) / launches.control_dt,
        "bounced": rise_time / launches.control_dt,
        "apex": apex,
        "target": target,
        "target_time": 0.5 * (bounce_time + rise_time),  # in the middle of the flight half of it is left
    }


def _slowed(velocity: Tensor, measured: Prior, at: Prior) -> Tensor:
    """Acceleration (N, 3): ``measured`` along x ``at`` that mean speed, where drag grows with its square."""
    mean = torch.tensor(measured.mean, dtype=torch.float64)
    drag = torch.tensor([1.0, 0.0, 0.0]) * (velocity[:, :1] / at.mean[0]).square()
    return mean * (drag + torch.tensor([0.0, 1.0, 1.0]))
