"""The predictor's priors for the serves of a task, transferred from the serves that they were measured on.

The defaults of :class:`pace.config.predictor.PredictorPriors` were measured on :data:`MEASURED_ON`. For other serves,
the flight model of :mod:`pace.predictor.filter` shifts each mean by its change for the middle of the ranges, and scales
each standard deviation by the change of its range over the corners of the ranges. For the measured serves the priors
equal the defaults, to the last digit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import torch
from torch import Tensor

from pace.config.base import Range
from pace.config.predictor import FRAME_DT, PredictorConfig, PredictorPriors, Prior
from pace.config.task import TaskConfig
from pace.predictor.filter import Parabola, rebound, time_to_table

NO_WIDTH = 1e-6  # smaller widths are rounding errors
LEAST_SHARE = 0.5  # of a measured standard deviation: balls, tables and noise differ even for the same serve


@dataclass(frozen=True)
class Launches:
    """Ranges of serves, m and m/s, the step between sensed positions, s, and the x of the paddle's target, m."""

    position: tuple[Range, Range, Range]
    velocity: tuple[Range, Range, Range]
    control_dt: float
    target_x: float

    @classmethod
    def of(cls, config: TaskConfig) -> Launches:
        """Those of a task."""
        serve = config.serve
        position, velocity = (serve.x, serve.y, serve.z), (serve.vx, serve.vy, serve.vz)
        return cls(position, velocity, config.robot.control_dt, config.reward.target_x)


#: The released training serves (configs/serve/train.yaml when the priors were measured), and reward.target_x.
MEASURED_ON = Launches(
    ([1.35, 1.35], [-0.1, 0.1], [1.03, 1.03]), ([-6.5, -5.0], [-0.8, 0.4], [1.5, 2.0]), FRAME_DT, -1.6
)


def resolve_priors(config: TaskConfig, learned: PredictorPriors | None = None) -> PredictorConfig:
    """The predictor's configuration with priors: the given ones, those of ``learned`` weights, or the serve's."""
    found = config.predictor.priors or learned or derive_priors(Launches.of(config))
    return replace(config.predictor, priors=found)


def derive_priors(launches: Launches) -> PredictorPriors:
    """Priors for these serves."""
    measured = PredictorPriors()
    middle, corners = _middle_and_corners(launches)
    here, there = _flights(middle, launches), _flights(_middle_and_corners(MEASURED_ON)[0], MEASURED_ON)
    reach = _flights(corners, launches), _flights(_middle_and_corners(MEASURED_ON)[1], MEASURED_ON)
    found: dict[str, Prior] = {}
    for name in here:
        prior: Prior = getattr(measured, name)
        moved = (here[name] - there[name])[0].tolist()
        wide, known = ((flights[name].amax(0) - flights[name].amin(0)).tolist() for flights in reach)
        shares = [max(a / b, LEAST_SHARE) if b > NO_WIDTH else 1.0 for a, b in zip(wide, known, strict=True)]
        mean = [a + b for a, b in zip(prior.mean, moved, strict=True)]
        found[name] = Prior(mean, [a * b for a, b in zip(prior.std, shares, strict=True)])
    return replace(measured, **found)


def _middle_and_corners(launches: Launches) -> tuple[Tensor, Tensor]:
    """Positions and velocities (1, 6) in the middle of the ranges, and (64, 6) at all their ends."""
    ranges = (*launches.position, *launches.velocity)
    middle = torch.tensor([[0.5 * (low + high) for low, high in ranges]], dtype=torch.float64)
    return middle, torch.tensor(list(product(*ranges)), dtype=torch.float64)


def _flights(launch: Tensor, launches: Launches) -> dict[str, Tensor]:
    """Quantities of the flights of ``launch`` (N, 6), by the name of the prior, (N, 3) or (N, 1)."""
    measured, velocity = PredictorPriors(), launch[:, 3:]
    fall = _slowed(velocity, measured.fall, measured.launch_velocity)
    before = Parabola(launch[:, :3], velocity, fall)
    bounce_time = time_to_table(before)
    bounce = before.at(bounce_time)
    rebounding = rebound(bounce.velocity)
    rise = _slowed(rebounding, measured.rise, measured.rise_velocity)
    after = Parabola(bounce.position, rebounding, rise)
    rise_time = rebounding[:, 2:] / after.gravity
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
