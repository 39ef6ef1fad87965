"""The optimal estimate of an apex: the posterior mean over all serves that are consistent with the sensed positions.

The posterior is sampled by Metropolis chains over :class:`pace.studies.flights.FlightModel`. Every distribution of the
task is uniform. So a point of the prior's cube is possible if every sensed position lies within the noise around its
flight, and all possible points are equally likely. Chains begin at the true sample, which is itself a sample from the
posterior, and forget it in their burn-in.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pace.config.training import TrainConfig
from pace.studies.flights import FlightModel

SMALLEST_NOISE = 1e-4  # m: assumed noise of a clean position
ROUNDING = 2e-5  # m, of float32 flights
STEP = 0.02  # of the cube, for the slopes of a flight
LARGEST_MOVE, SHARE_MOVED = 1.5, 0.3  # of a deviation; of the axes
APEX_EVERY = 4  # steps between samples of a chain's apex


@dataclass(frozen=True)
class Question:
    """Q questions: the apex of a serve that was sensed up to a control step."""

    cube: Tensor  # (Q, D) the truth
    sensed: Tensor  # (Q, T, 3) m
    used: Tensor  # (Q, T) bool, the frames that are known

    def repeat(self, chains: int) -> Question:
        """Every question ``chains`` times."""
        return Question(*(part.repeat_interleave(chains, dim=0) for part in (self.cube, self.sensed, self.used)))


@dataclass(frozen=True)
class Answer:
    """Posterior of the apex of each question: mean (Q, 3) m, and ``std`` (Q,) m, root of its variance in 3-D."""

    mean: Tensor
    std: Tensor


def proposal(model: FlightModel, question: Question, noise: float) -> Tensor:
    """(Q, D, D) columns: axes of the posterior's ellipsoid, as long as its standard deviations, for linear flights."""
    dims = question.cube.shape[1]
    slopes = []
    for d in range(dims):
        step = torch.zeros(dims)
        step[d] = STEP
        ahead, behind = (model.sensed(question.cube + sign * step, question.sensed.shape[1]) for sign in (1, -1))
        slopes.append(((ahead - behind) * question.used.unsqueeze(-1)).flatten(1) / (2 * STEP))
    slope = torch.stack(slopes, dim=2).double()  # (Q, 3 T, D)
    information = 12.0 * torch.eye(dims, dtype=torch.double) + slope.mT @ slope * (3.0 / noise**2)
    variance, axes = torch.linalg.eigh(torch.linalg.inv(information))
    return (axes * variance.clamp(min=0.0).sqrt().unsqueeze(1)).float()


def answer(config: TrainConfig, question: Question, chains: int, steps: int, seed: int = 1) -> Answer:
    """Posterior mean and std of the apex, from ``chains`` chains of ``steps``; their first third is burn-in.

    A step moves along some of the axes of :func:`proposal`, by random distances: along all of them at once few points
    are possible, and the standard deviations of the axes differ by a factor of a hundred.
    """
    noise = max(config.sensing.ball_position, SMALLEST_NOISE)
    count, dims = question.cube.shape
    factor = proposal(FlightModel(config, count), question, noise).repeat_interleave(chains, dim=0)
    model, many = FlightModel(config, count * chains), question.repeat(chains)
    generator = torch.Generator().manual_seed(seed)
    place = many.cube.clone()
    sums = torch.zeros(3, count * chains, 3)  # of the apex, of its square, and how many
    for step in range(steps):
        scale = LARGEST_MOVE * torch.rand(count * chains, 1, generator=generator)
        move = torch.randn(count * chains, dims, 1, generator=generator)
        move *= torch.rand(count * chains, dims, 1, generator=generator) < SHARE_MOVED
        there = place + scale * (factor @ move).squeeze(-1)
        place = torch.where(_possible(model, many, there, noise).unsqueeze(-1), there, place)
        if step >= steps // 3 and step % APEX_EVERY == 0:
            apex = model.apex(place)
            sums += torch.stack([apex, apex.square(), torch.ones_like(apex)]).nan_to_num() * apex.isfinite()
    total = sums.view(3, count, chains, 3).sum(2)
    mean = total[0] / total[2]
    variance = (total[1] / total[2] - mean.square()).clamp(min=0.0)
    return Answer(mean, variance.sum(1).sqrt())


def _possible(model: FlightModel, question: Question, cube: Tensor, noise: float) -> Tensor:
    """(M,) bool: points of the prior whose flights are consistent with all sensed positions."""
    off = (model.sensed(cube.clamp(0.0, 1.0), question.sensed.shape[1]) - question.sensed).abs().amax(2)
    explained = ((off <= noise + ROUNDING) | ~question.used).all(1)
    return explained & ((cube >= 0.0) & (cube <= 1.0)).all(1) & model.served(cube.clamp(0.0, 1.0))
