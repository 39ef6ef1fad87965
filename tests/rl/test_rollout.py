"""Rollouts: what is stored, advantages at truncation and termination, and the errors of a check."""

from __future__ import annotations

import re

import torch
from torch import Tensor

from pace.rl.agent import Agent
from pace.rl.rollout import Rollout
from tests.helpers.algo import CPU, small_algo
from tests.helpers.dummy import DummyTask

STEPS = 6


def play(env: DummyTask, steps: int = STEPS, autocast: str = "fp32") -> tuple[Agent, Rollout]:
    torch.manual_seed(5)
    agent = Agent(6, 7, 2, small_algo(autocast=autocast), CPU)
    rollout = Rollout(env, agent, steps)
    rollout.begin()
    for t in range(steps):
        rollout.step(t)
    rollout.finish(0.9, 0.8)
    return agent, rollout


def hand_computed_gae(reward: Tensor, value: Tensor, terminal: Tensor, terminated: Tensor, truncated: Tensor) -> Tensor:
    """GAE of one world by its definition; ``value`` (T + 1,), ``terminal`` the value of the state before a reset."""
    gamma, lam, running = 0.9, 0.8, 0.0
    advantage = torch.zeros_like(reward)
    for t in reversed(range(len(reward))):
        following = 0.0 if terminated[t] else (terminal if truncated[t] else value[t + 1])
        delta = reward[t] + gamma * following - value[t]
        ends = bool(terminated[t] or truncated[t])
        running = delta + (0.0 if ends else gamma * lam * running)
        advantage[t] = running
    return advantage


def test_gae_bootstraps_a_truncation_from_its_terminal_state_only() -> None:
    _, rollout = play(DummyTask(4))
    rollout.terminated.zero_()
    rollout.truncated.zero_()
    rollout.truncated[2, 0] = True
    rollout.terminated[3, 1] = True
    rollout.truncated[5, 2] = True
    rollout.value.copy_(torch.randn(rollout.value.shape, generator=torch.Generator().manual_seed(1)))
    rollout.estimate_advantage(0.9, 0.8)
    for world in range(4):
        expected = hand_computed_gae(
            rollout.reward[:, world],
            rollout.value[: STEPS + 1, world],
            rollout.value[STEPS + 1, world],
            rollout.terminated[:, world],
            rollout.truncated[:, world],
        )
        torch.testing.assert_close(rollout.advantage[:, world], expected)
        torch.testing.assert_close(rollout.value_target[:, world], expected + rollout.value[:STEPS, world])


def test_terminal_value_is_that_of_the_observation_before_the_reset() -> None:
    env = DummyTask(4, length=20)
    env.age.copy_(torch.tensor([19, 17, 3, 0]))  # truncated in the first and the third step; not at all
    seen: list[Tensor] = []
    advance = env.advance

    def watched(action: Tensor) -> None:
        advance(action)
        seen.append(env.critic_observation.clone())

    env.advance = watched  # type: ignore[method-assign]
    agent, rollout = play(env)
    assert rollout.truncated[:, 0].tolist() == [True] + 5 * [False]
    assert rollout.truncated[:, 1].tolist() == [False, False, True, False, False, False]
    terminal = torch.stack([seen[0][0], seen[2][1]])
    with torch.no_grad():
        expected = agent.critic(agent.critic_norm(terminal)).squeeze(1)
    torch.testing.assert_close(rollout.value[STEPS + 1, :2], expected)


def test_stored_log_probability_is_that_of_the_stored_action() -> None:
    agent, rollout = play(DummyTask(16))
    normal = torch.distributions.Normal(rollout.loc, agent.actor.std)
    torch.testing.assert_close(rollout.log_prob, normal.log_prob(rollout.action).sum(-1), rtol=1e-4, atol=1e-4)
    with torch.no_grad():
        torch.testing.assert_close(agent.actor.mlp(rollout.policy), rollout.loc, rtol=1e-4, atol=1e-5)


def test_observations_are_stored_in_the_networks_format() -> None:
    _, rollout = play(DummyTask(16), autocast="bf16")
    assert rollout.policy.dtype == rollout.critic.dtype == torch.bfloat16
    assert rollout.value.dtype == rollout.action.dtype == torch.float32


def test_values_are_those_of_the_stored_critic_observations() -> None:
    agent, rollout = play(DummyTask(16))
    with torch.no_grad():
        torch.testing.assert_close(rollout.value, agent.critic(rollout.critic).squeeze(-1))


def test_a_nan_is_reported_with_its_world_and_term() -> None:
    env = DummyTask(8)
    env.poison_step = 3
    _, rollout = play(env)
    assert re.search(r"policy column 1 of world 3 at step 3.*term position of world 3", rollout.fault() or "")


def test_a_reward_that_is_not_finite_is_reported() -> None:
    _, rollout = play(DummyTask(8))
    assert rollout.fault() is None
    rollout.reward[4, 6] = float("inf")
    assert "reward of world 6 at step 4" in (rollout.fault() or "")


def test_two_truncations_within_a_rollout_are_refused() -> None:
    _, rollout = play(DummyTask(8, length=2))
    assert "algo.steps must be shorter than an episode" in (rollout.fault() or "")
