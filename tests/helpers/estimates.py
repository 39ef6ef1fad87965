"""Estimates in tests: of made-up robots, and what every one of them must do in the task."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pace.onboard.estimate import Estimate
from pace.onboard.estimates import ESTIMATES
from pace.task.env import TableTennisEnv
from tests.helpers.envs import make_env


class Running:
    """An estimate of N made-up robots whose state is kept: all begin at once.

    Attributes: ``state`` (N, S). Args: reads: what it is given now, by name.
    """

    def __init__(self, module: Estimate, reads: Callable[[], dict[str, Tensor]]) -> None:
        self._module, self._reads = module, reads
        self.state = module.begin(**reads()).clone()

    def update(self) -> None:
        """One control step later."""
        self.state = self._module(self.state, **self._reads())

    def restart(self, mask: Tensor) -> None:
        """A new episode in the worlds of ``mask`` (N,) bool."""
        self.state = torch.where(mask.unsqueeze(1), self._module.begin(**self._reads()), self.state)

    def __getitem__(self, part: str) -> Tensor:
        """(N, size), a part of the state."""
        return self.state[:, self._module.columns[part]]


def estimated(env: TableTennisEnv, name: str, part: str) -> Tensor:
    """A part (N, size) of an estimate of the task's robots, on its own memory."""
    return env.actor.estimates[name][:, env.actor.onboard.estimate(name).columns[part]]


def check_observed_kept_and_begun(name: str) -> None:
    """The policy sees the estimate ``name``, it is part of the state, and a new episode begins it from scratch."""
    env = make_env(2, "native", "cpu", overrides=["observation=memory", "engine.threads=1"])
    state = env.actor.estimates[name]
    for _ in range(5):
        env.advance(torch.zeros(2, 21))
    frame = env.policy_observation.view(2, 5, -1)[:, -1]
    for observation, part in ESTIMATES[name].observations.items():
        assert torch.equal(frame[:, env.policy_layout[observation]], estimated(env, name, part))
    saved, kept = env.state_dict(), state.clone()
    env.reset_worlds(torch.tensor([True, False]))
    assert torch.equal(state[1], kept[1])
    assert not torch.equal(state[0], kept[0])
    env.load_state_dict(saved)
    assert torch.equal(state, kept)
