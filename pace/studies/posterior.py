"""The best that can be known of an apex: the mean of all serves that explain what was sensed of one.

The posterior is sampled by Metropolis chains over :class:`pace.studies.flights.FlightModel`. Every distribution of the
task is uniform, so a point of the prior's cube is possible when every sensed position lies within the noise of where
its flight would be seen, and all possible points are equally likely. Chains begin at what was really drawn, which is
itself one draw from the posterior, and forget it in the first part of the way.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pace.config.training import TrainConfig
from pace.studies.flights import FlightModel

SMALLEST_NOISE = 1e-4  # m: a clean position is taken as known to this
ROUNDING = 2e-5  # m, of float32 flights
STEP = 0.02  # of the cube, for the slopes of a flight
LARGEST_MOVE, SHARE_MOVED = 1.5, 0.3  # of a deviation; of the axes
APEX_EVERY = 4  # steps between the looks at a chain's apex


@dataclass(frozen=True)
class Question:
    """Q times: a serve was seen up to a control step. What is its apex?"""

    cube: Tensor  # (Q, D) the truth
    sensed: Tensor  # (Q, T, 3) m
    used: Tensor  # (Q, T) bool, the frames that are known

    def repeat(self, chains: int) -> Question:
        """Every question ``chains`` times."""
        return Question(*(part.repeat_interleave(chains, dim=0) for part in (self.cube, self.sensed, self.used)))


@dataclass(frozen=True)
class Answer:
    """Posterior of the apex of each question: mean (Q, 3) m, and ``spread`` (Q,) m, root of its variance in 3-D."""

    mean: Tensor
    spread: Tensor


def proposal(model: FlightModel, question: Question, noise: float) -> Tensor:
    """(Q, D, D) columns: axes of the posterior's ellipsoid, as long as its deviations, were flights linear."""
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
    """Posterior mean and spread of the apex, from ``chains`` chains of ``steps``; their first third is forgotten.

    A step moves along some of the axes of :func:`proposal`, more or less far: with all of them at once few places are
    possible, and what is unknown and what is known well differ in size by a hundred.
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
    """(M,) bool: points of the prior whose flights explain all that is known."""
    off = (model.sensed(cube.clamp(0.0, 1.0), question.sensed.shape[1]) - question.sensed).abs().amax(2)
    explained = ((off <= noise + ROUNDING) | ~question.used).all(1)
    return explained & ((cube >= 0.0) & (cube <= 1.0)).all(1)
