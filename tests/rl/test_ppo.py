"""The PPO update: against a plain implementation of its first step, and what it must keep within bounds."""

from __future__ import annotations

import copy
import math

import pytest
import torch

from pace.config.base import ConfigError
from pace.config.schedules import START, Position, SchedulePoint
from pace.config.training import AlgoConfig
from pace.rl.agent import Agent
from pace.rl.ppo import PPO
from pace.rl.rollout import Rollout, RolloutError
from tests.helpers.algo import CPU, small_algo
from tests.helpers.dummy import DummyTask


def played(config: AlgoConfig, worlds: int = 32, steps: int = 8) -> tuple[Agent, Rollout]:
    torch.manual_seed(7)
    agent = Agent(6, 7, 2, config, CPU)
    rollout = Rollout(DummyTask(worlds), agent, steps)
    rollout.begin()
    for t in range(steps):
        rollout.step(t)
    rollout.finish(config.gamma, config.gae_lambda)
    return agent, rollout


def test_first_step_is_that_of_a_plain_ppo() -> None:
    # one learning rate: rounding in the first KL could already move it
    config = small_algo(epochs=1, minibatches=1, learning_rate_min=1e-3, learning_rate_max=1e-3)
    agent, rollout = played(config)
    plain = copy.deepcopy(agent)
    metrics = PPO(agent, config).update(rollout, START)

    advantage = rollout.advantage.flatten()
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    normal = torch.distributions.Normal(
        plain.actor.mlp(rollout.policy), plain.actor.spread.state_independent_scale.exp()
    )
    ratio = (normal.log_prob(rollout.action).sum(-1) - rollout.log_prob).exp().flatten()
    objective = -torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    entropy = normal.entropy().sum(-1).mean()
    value = plain.critic(rollout.critic[:8]).squeeze(-1)
    clipped = rollout.value[:8] + (value - rollout.value[:8]).clamp(-config.clip, config.clip)
    targets = rollout.value_target
    critic = torch.maximum((value - targets).square(), (clipped - targets).square()).mean()
    (objective - config.entropy[0].value * entropy + critic).backward()
    for part in (plain.actor, plain.critic):
        torch.nn.utils.clip_grad_norm_(part.parameters(), config.max_grad_norm)
        torch.optim.Adam(part.parameters(), lr=config.learning_rate).step()
    plain.actor.bound_std(config.std_floor, config.std[0].value)

    assert metrics["loss_critic"] == pytest.approx(critic.item(), rel=1e-4)
    assert metrics["entropy"] == pytest.approx(entropy.item(), rel=1e-5)
    assert metrics["kl"] == pytest.approx(0.0, abs=1e-6)
    for mine, theirs in zip(agent.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-5)


def test_kl_metric_is_the_divergence_of_the_two_gaussians() -> None:
    config = small_algo(epochs=1, minibatches=1)
    agent, rollout = played(config)
    ppo = PPO(agent, config)
    with torch.no_grad():
        agent.actor.mlp.layers[-1].bias += 0.1  # type: ignore[union-attr]
        agent.actor.spread.state_independent_scale.sub_(0.2)
    new = torch.distributions.Normal(agent.actor.mlp(rollout.policy).detach(), agent.actor.std)
    old = torch.distributions.Normal(rollout.loc, rollout.scale)
    expected = torch.distributions.kl_divergence(old, new).sum(-1).mean().item()
    assert ppo.update(rollout, START)["kl"] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("autocast", ["fp32", "bf16"])
def test_updates_change_every_parameter_and_lower_the_critic_loss(autocast: str) -> None:
    config = small_algo(autocast=autocast, epochs=8, clip_value=False)  # a clipped value moves by 0.2 at most
    agent, rollout = played(config)
    before = {name: p.detach().clone() for name, p in agent.named_parameters()}
    ppo = PPO(agent, config)
    first = ppo.update(rollout, START)
    for _ in range(10):
        last = ppo.update(rollout, START)
    assert all(not torch.equal(before[name], p) for name, p in agent.named_parameters())
    assert last["loss_critic"] < 0.7 * first["loss_critic"]


def test_learning_rate_falls_when_the_policy_moves_too_far() -> None:
    config = small_algo(kl_target=[SchedulePoint(0, 1e-7)], epochs=4)
    agent, rollout = played(config)
    ppo = PPO(agent, config)
    for _ in range(3):
        metrics = ppo.update(rollout, START)
    assert config.learning_rate_min <= metrics["lr"] < config.learning_rate
    assert ppo.critic_optimiser.param_groups[0]["lr"] == config.learning_rate


def test_schedules_follow_the_samples() -> None:
    std = [SchedulePoint(0, 0.6), SchedulePoint(100, 0.2)]
    entropy = [SchedulePoint(0, 0.01), SchedulePoint(100, 0.0)]
    config = small_algo(std=std, entropy=entropy, std_floor=0.0)
    agent, rollout = played(config)
    ppo = PPO(agent, config)
    metrics = ppo.update(rollout, Position(50))
    assert metrics["policy_std"] <= 0.4 + 1e-6
    assert ppo.loss.get_buffer("entropy_coeff").item() == pytest.approx(0.005)


def test_more_minibatches_than_samples_are_refused() -> None:
    config = small_algo(minibatches=100)
    agent, rollout = played(config, worlds=4, steps=4)
    with pytest.raises(ConfigError, match=r"algo\.minibatches 100"):
        PPO(agent, config).update(rollout, START)


def test_a_loss_that_is_not_finite_is_an_error() -> None:
    config = small_algo()
    agent, rollout = played(config)
    rollout.value_target[0, 0] = math.nan
    with pytest.raises(RolloutError, match=r"loss_critic|grad_norm_critic"):
        PPO(agent, config).update(rollout, START)


def test_state_restores_the_optimisers() -> None:
    config = small_algo()
    agent, rollout = played(config)
    ppo = PPO(agent, config)
    ppo.update(rollout, START)
    twin_agent = copy.deepcopy(agent)
    twin = PPO(twin_agent, config)
    twin.load_state_dict(copy.deepcopy(ppo.state_dict()))
    for learner in (ppo, twin):
        torch.manual_seed(11)
        learner.update(rollout, START)
    for mine, theirs in zip(agent.parameters(), twin_agent.parameters(), strict=True):
        assert torch.equal(mine, theirs)


def test_at_a_small_spread_the_kl_of_bf16_networks_is_rounding() -> None:
    """Why ``algo.fp32_below`` is there: weights that hardly move, and a KL divergence that the number format makes."""
    kl = {}
    for autocast in ("bf16", "fp32"):
        config = small_algo(
            autocast=autocast, std=[SchedulePoint(0.0, 0.05)], learning_rate=1e-8, learning_rate_min=1e-8,
            learning_rate_max=1e-8, last_layer_gain=1.0, actor_hidden=[256, 128],
        )  # fmt: skip
        agent, rollout = played(config)
        kl[autocast] = PPO(agent, config).update(rollout, START)["kl"]
    assert 0 < kl["fp32"] < 0.1 * kl["bf16"]
