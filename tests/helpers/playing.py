"""A small environment that is played with graphs and without."""

from __future__ import annotations

from typing import Any

import torch

from pace.predictor.network import PredictorNetwork
from pace.task.env import TableTennisEnv
from tests.helpers.fakes import config

N, STEPS = 4, 50
PUSHED = (
    "engine=mjwarp",
    "randomization.push_interval=[0.02,0.04]",
    "serve.serves_per_episode=2",
    "serve.max_duration=0.2",
)


def make(device: str = "cpu", *overrides: str) -> TableTennisEnv:
    """An environment with a predictor, pushes and short episodes; the same each time."""
    settings = config(*PUSHED, *overrides)
    torch.manual_seed(0)
    return TableTennisEnv(settings, N, device, 1, PredictorNetwork(settings.predictor).to(device))


def play(env: TableTennisEnv, steps: int = STEPS) -> list[dict[str, Any]]:
    """States after each of some steps under random actions, some worlds being reset besides those that are done."""
    generator, states = torch.Generator().manual_seed(0), []
    for _ in range(steps):
        action = 0.5 * torch.randn(N, 21, generator=generator)
        extra = torch.rand(N, generator=generator) < 0.05
        env.advance(action.to(env.worlds.nominal.device))
        env.reset_worlds(env.terminated | env.truncated | extra.to(env.terminated.device))
        states.append(env.state_dict())
    return states
