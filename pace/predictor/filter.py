"""Two parabolas through the whole flight so far, joined by the bounce: least squares with priors, on tensors.

Position, velocity and acceleration of each axis are fitted to every sensed position before the bounce. A second fit
covers the positions after it, starting from the first parabola's position and velocity at the table. Launch, gravity,
drag and the table are priors, as wide as the variation over serves and balls; the network after the fit learns the
residual. The serve's priors come from the configuration (``PredictorPriors``). Only positions are
used, so a window over the whole flight is the entire state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pace.config.predictor import FRAME_DT as FRAME
from pace.config.predictor import PredictorPriors

UNIT = 0.4  # s; times in the fits are in this unit, so that the sums are of order one
NOISE = 0.004  # m, standard deviation of a sensed position (uniform +-7 mm)
CONTACT_HEIGHT = 0.78  # m, centre of a ball on the table
LOW = 0.9  # m; a ball that starts to rise below it has bounced: in 20 ms it falls 6 cm at most
# A sensed position is up to 10 ms old, and linear between frames: around the bounce it is on neither parabola.
AFTER_BOUNCE = 0.013  # s
LEAST_GRAVITY = 5.0  # m/s^2 downwards, for a rolling ball, which does not fly
SEEN = (1.0, 1.0, 1.0)  # m
BOUNCE_WIDTH = ((0.003, 0.003, 0.003), (0.25, 0.06, 0.06))  # of position and velocity after the bounce
RESTITUTION, FRICTION = 0.92, 0.225  # of the table, in the middle of all presets


class Parabola(NamedTuple):
    """Position (N, 3) m, velocity (N, 3) m/s and acceleration (N, 3) m/s^2 at its time zero."""

    position: Tensor
    velocity: Tensor
    acceleration: Tensor

    def at(self, time: Tensor) -> Parabola:
        """The same with its time zero at ``time`` (N, 1) s."""
        position = self.position + time * (self.velocity + 0.5 * time * self.acceleration)
        return Parabola(position, self.velocity + time * self.acceleration, self.acceleration)

    @property
    def gravity(self) -> Tensor:
        """(N, 1) m/s^2 downwards."""
        return (-self.acceleration[:, 2:]).clamp(min=LEAST_GRAVITY)


class Flight(NamedTuple):
    """The fit of a window of positions: ``age`` (N, 1) s since the first, ``before`` the parabola before the bounce at
    the newest frame, ``bounce_age`` (N, 1) s since the bounce (negative: still to come), ``after`` the parabola from
    the bounce on, ``seen`` (N, 1) frames on it."""

    age: Tensor
    before: Parabola
    bounce_age: Tensor
    after: Parabola
    seen: Tensor

    @property
    def apex_delay(self) -> Tensor:
        """(N, 1) s from the bounce to the apex."""
        return self.after.velocity[:, 2:] / self.after.gravity

    @property
    def apex(self) -> Tensor:
        """(N, 3) m, the highest point of the second parabola."""
        return self.after.at(self.apex_delay).position


class Fit(nn.Module):
    """Least squares of parabolas with priors, each axis separately.

    Args: width (3, 3) standard deviations of the prior, rows position m, velocity m/s,
    acceleration m/s^2, columns axes.
    """

    scale: Tensor
    prior: Tensor

    def __init__(self, width: tuple[Sequence[float], ...]) -> None:
        super().__init__()
        scale = torch.tensor([1.0, UNIT, 0.5 * UNIT**2])
        self.register_buffer("scale", scale, persistent=False)
        precision = (NOISE / (torch.tensor(width) * scale.unsqueeze(1))).square()
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
    """Fits a :class:`Flight` to each of N windows of ``window`` positions, with the ``priors`` of their serves."""

    ages: Tensor
    means: Tensor

    def __init__(self, window: int, priors: PredictorPriors) -> None:
        super().__init__()
        self.fall = Fit((SEEN, priors.launch_velocity.std, priors.fall.std))
        self.rise = Fit((*BOUNCE_WIDTH, priors.rise.std))
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
        low, rises = frames[:, 2] < LOW, frames[:, 2, 1:] > frames[:, 2, :-1]
        turns = torch.cat([low[:, :-1] & rises, low[:, -1:]], dim=1).to(frames.dtype)
        turned, where = turns.max(1, keepdim=True)
        falling = ages < torch.where(turned > 0.0, self.ages[where], FRAME) - 0.5 * FRAME
        counts = (falling & (ages > -age - 0.5 * FRAME)).to(frames.dtype)
        velocity, fall, rise = (mean.expand_as(frames[..., 0]) for mean in self.means)
        before = self.fall(ages + age, counts, frames, Parabola(frames[..., 0], velocity, fall)).at(age)
        ahead = time_to_table(before)
        bounce, time = before.at(ahead), ages - ahead
        counts = (time >= AFTER_BOUNCE).to(frames.dtype)
        after = self.rise(time, counts, frames, Parabola(bounce.position, rebound(bounce.velocity), rise))
        return Flight(age, before, -ahead, after, counts.sum(1, keepdim=True))


def time_to_table(flight: Parabola) -> Tensor:
    """(N, 1) s until a falling parabola reaches the table, negative if that is past; until its top if it never does."""
    speed, height = flight.velocity[:, 2:], flight.position[:, 2:] - CONTACT_HEIGHT
    under = speed.square() + 2.0 * flight.gravity * height
    return (speed + under.clamp(min=0.0).sqrt()) / flight.gravity


def rebound(velocity: Tensor) -> Tensor:
    """Velocity (N, 3) m/s after a sliding bounce without spin, of the middle of all tables."""
    push = (1.0 + RESTITUTION) * velocity[:, 2:].abs()
    along = velocity[:, :2]
    speed = along.square().sum(1, keepdim=True).sqrt().clamp(min=1e-3)
    return torch.cat([along * (1.0 - FRICTION * push / speed), velocity[:, 2:] + push], dim=1)
