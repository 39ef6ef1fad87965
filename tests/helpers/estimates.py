"""What every estimate of the robot must do in the task, whatever it estimates."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from pace.task.env import make_env


def check_observed_kept_and_begun(name: str, observed: Mapping[str, str]) -> None:
    """The policy sees the estimate ``name`` of the actor, it is part of the state, and a new episode begins it anew.

    ``observed``: observation -> attribute of the estimate.
    """
    env = make_env(2, "native", "cpu", overrides=["observation=memory", "engine.threads=1"])
    estimate = getattr(env.actor, name)
    for _ in range(5):
        env.advance(torch.zeros(2, 21))
    frame = env.policy_observation.view(2, 5, -1)[:, -1]
    for observation, attribute in observed.items():
        assert torch.equal(frame[:, env.policy_layout[observation]], getattr(estimate, attribute))
    saved, kept = env.state_dict(), estimate.state.clone()
    env.reset_worlds(torch.tensor([True, False]))
    assert torch.equal(estimate.state[1], kept[1])
    assert not torch.equal(estimate.state[0], kept[0])
    env.load_state_dict(saved)
    assert torch.equal(estimate.state, kept)
