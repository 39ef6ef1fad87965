"""Two parabolas through the whole flight so far, joined by the bounce: least squares with priors, on tensors.

Position, velocity and acceleration of each axis are fitted to every sensed position before the bounce. A second fit
covers the positions after it, starting from the first parabola's position and velocity at the table. Launch, gravity,
drag and the table are priors, as wide as the variation over serves and balls; the network after the fit learns the
residual. All numbers come from the configuration (``PredictorPriors``, ``FlightFit``). Only positions are used, so a
window over the whole flight is the entire state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pace.config.predictor import FRAME_DT as FRAME
from pace.config.predictor import FlightFit, PredictorPriors

UNIT = 0.4  # s; times in the fits are in this unit, so that the sums are of order one
LEAST_SPEED = 1e-3  # m/s along the table, which a velocity is divided by


class Parabola(NamedTuple):
    """Position (N, 3) m, velocity (N, 3) m/s and acceleration (N, 3) m/s^2 at its time zero."""

    position: Tensor
    velocity: Tensor
    acceleration: Tensor

    def at(self, time: Tensor) -> Parabola:
        """The same with its time zero at ``time`` (N, 1) s."""
        position = self.position + time * (self.velocity + 0.5 * time * self.acceleration)
        return Parabola(position, self.velocity + time * self.acceleration, self.acceleration)

    def gravity(self, least: float) -> Tensor:
        """(N, 1) m/s^2 downwards, ``least`` or more."""
        return (-self.acceleration[:, 2:]).clamp(min=least)


class Flight(NamedTuple):
    """The fit of a window of positions: ``age`` (N, 1) s since the first, ``before`` the parabola before the bounce at
    the newest frame, ``bounce_age`` (N, 1) s since the bounce (negative: still to come), ``after`` the parabola from
    the bounce on, ``seen`` (N, 1) frames on it, ``apex_delay`` (N, 1) s from the bounce to the apex."""

    age: Tensor
    before: Parabola
    bounce_age: Tensor
    after: Parabola
    seen: Tensor
    apex_delay: Tensor

    @property
    def apex(self) -> Tensor:
        """(N, 3) m, the highest point of the second parabola."""
        return self.after.at(self.apex_delay).position


class Fit(nn.Module):
    """Least squares of parabolas with priors, each axis separately.

    Args: width (3, 3) standard deviations of the prior, rows position m, velocity m/s,
    acceleration m/s^2, columns axes; noise m, standard deviation of a position.
    """

    scale: Tensor
    prior: Tensor

    def __init__(self, width: tuple[Sequence[float], ...], noise: float) -> None:
        super().__init__()
        scale = torch.tensor([1.0, UNIT, 0.5 * UNIT**2])
        self.register_buffer("scale", scale, persistent=False)
        precision = (noise / (torch.tensor(width) * scale.unsqueeze(1))).square()
        self.register_buffer("prior", torch.diag_embed(precision.T), persistent=False)  # (axis, 3, 3)

    def forward(self, time: Tensor, weight: Tensor, position: Tensor, mean: Parabola) -> Parabola:
        """Time (N, W) s, weight (N, W) 1 if a position counts, else 0, position (N, 3, W) m, the prior's mean."""
        centre = torch.stack(mean, dim=2) * self.scale  # (N, axis, 3)
        once = (time / UNIT).unsqueeze(1)
        twice = once.square()
        rest = position - (centre[..., :1] + centre[..., 1:2] * once + centre[..., 2:] * twice)
        powers = [weight.unsqueeze(1) * power for power in (torch.ones_like(once), once, twice)]
        sums = [power.sum(2) for power in (*powers, powers[1] * twice, powers[2] * twice)]
        rows = [torch.cat(sums[n : n + 3], dim=1) for n in range(3)]
        matrix = torch.stack(rows, dim=1).unsqueeze(1) + self.prior  # (N, axis, 3, 3)
        change = solve(matrix, torch.stack([(power * rest).sum(2) for power in powers], dim=2))
        return Parabola(*((centre + change) / self.scale).unbind(2))


def solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """x of ``matrix`` x = ``vector`` for symmetric (..., 3, 3) and (..., 3), by cofactors, which any runtime has."""
    a, b, c = matrix.unbind(-2)
    cofactors = [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)]
    determinant = (a * cofactors[0]).sum(-1, keepdim=True)
    parts = zip(cofactors, vector.split(1, dim=-1), strict=True)
    return torch.stack([row * part for row, part in parts]).sum(0) / determinant


class FlightFilter(nn.Module):
    """Fits a :class:`Flight` to each of N windows of ``window`` positions, with the ``priors`` of their serves and the
    numbers of ``fit``."""

    ages: Tensor
    means: Tensor

    def __init__(self, window: int, priors: PredictorPriors, fit: FlightFit) -> None:
        super().__init__()
        self.numbers = fit
        self.fall = Fit((fit.launch_width, priors.launch_velocity.std, priors.fall.std), fit.noise)
        self.rise = Fit((fit.bounce_width, fit.rebound_width, priors.rise.std), fit.noise)
        self.register_buffer("ages", FRAME * torch.arange(1.0 - window, 1.0), persistent=False)
        means = torch.tensor([priors.launch_velocity.mean, priors.fall.mean, priors.rise.mean])
        self.register_buffer("means", means, persistent=False)

    def forward(self, frames: Tensor) -> Flight:
        """(N, W, 3) m, oldest first, the first position repeated if the flight is shorter."""
        frames = frames.mT.contiguous()
        ages = self.ages.expand(frames.shape[0], -1)
        moved = (frames[..., 1:] != frames[..., :-1]).any(1).to(frames.dtype)
        age = FRAME * moved.sum(1, keepdim=True)
        # the ball has not bounced before the first low position from which it rises; at that position it may have
        low, rises = frames[:, 2] < self.numbers.low, frames[:, 2, 1:] > frames[:, 2, :-1]
        turns = torch.cat([low[:, :-1] & rises, low[:, -1:]], dim=1).to(frames.dtype)
        turned, where = turns.max(1, keepdim=True)
        falling = ages < torch.where(turned > 0.0, self.ages[where], FRAME) - 0.5 * FRAME
        counts = (falling & (ages > -age - 0.5 * FRAME)).to(frames.dtype)
        velocity, fall, rise = (mean.expand_as(frames[..., 0]) for mean in self.means)
        before = self.fall(ages + age, counts, frames, Parabola(frames[..., 0], velocity, fall)).at(age)
        ahead = time_to_table(before, self.numbers)
        bounce, time = before.at(ahead), ages - ahead
        counts = (time >= self.numbers.after_bounce).to(frames.dtype)
        rebounding = rebound(bounce.velocity, self.numbers)
        after = self.rise(time, counts, frames, Parabola(bounce.position, rebounding, rise))
        apex_delay = after.velocity[:, 2:] / after.gravity(self.numbers.least_gravity)
        return Flight(age, before, -ahead, after, counts.sum(1, keepdim=True), apex_delay)


def time_to_table(flight: Parabola, fit: FlightFit) -> Tensor:
    """(N, 1) s until a falling parabola reaches the table, negative if that is past; until its top if it never does."""
    speed, height = flight.velocity[:, 2:], flight.position[:, 2:] - fit.contact_height
    gravity = flight.gravity(fit.least_gravity)
    under = speed.square() + 2.0 * gravity * height
    return (speed + under.clamp(min=0.0).sqrt()) / gravity


def rebound(velocity: Tensor, fit: FlightFit) -> Tensor:
    """Velocity (N, 3) m/s after a sliding bounce without spin, of the middle of all tables."""
    push = (1.0 + fit.restitution) * velocity[:, 2:].abs()
    along = velocity[:, :2]
    speed = along.square().sum(1, keepdim=True).sqrt().clamp(min=LEAST_SPEED)
    return torch.cat([along * (1.0 - fit.friction * push / speed), velocity[:, 2:] + push], dim=1)
