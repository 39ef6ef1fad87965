"""Normaliser, networks, the bounded spread, schedules and the deterministic policy."""

from __future__ import annotations

import math

import pytest
import torch

from pace.config.base import ConfigError
from pace.config.schedules import Position, SchedulePoint, scheduled
from pace.distributed import ProcessGroup
from pace.rl.agent import Agent, Policy, RunningNorm, compute_dtype
from tests.helpers.algo import CPU, small_algo


def test_running_norm_merges_batches_to_the_moments_of_all_samples() -> None:
    data = 3.0 + 2.0 * torch.randn(1000, 4, generator=torch.Generator().manual_seed(1))
    data[:, 3] = 1000.0 + 0.5 * data[:, 3]  # a large mean must not eat the variance
    norm = RunningNorm(4, clip=5.0)
    for batch in data.split([300, 1, 599, 100]):
        norm.update(batch)
    assert norm.count.item() == 1000
    torch.testing.assert_close(norm.mean.float(), data.mean(0), rtol=1e-6, atol=1e-5)
    torch.testing.assert_close(norm.var.float(), data.var(0, correction=0), rtol=1e-4, atol=1e-5)
    expected = ((data - data.mean(0)) / data.std(0, correction=0)).clamp(-5, 5)
    torch.testing.assert_close(norm(data)[:, :3], expected[:, :3], rtol=1e-3, atol=1e-3)


def test_running_norm_clips_and_writes_in_the_stored_format() -> None:
    norm = RunningNorm(1, clip=2.0)
    norm.update(torch.tensor([[-1.0], [1.0]]))
    out = torch.zeros(3, 1, dtype=torch.bfloat16)
    norm.normalise_into(torch.tensor([[-100.0], [0.5], [100.0]]), out)
    assert out.flatten().tolist() == pytest.approx([-2.0, 0.5, 2.0], abs=2e-3)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_running_norm_remembers_a_value_that_is_not_finite(bad: float) -> None:
    norm = RunningNorm(2, clip=5.0)
    norm.update(torch.randn(8, 2))
    assert norm.finite
    poisoned = torch.randn(8, 2)
    poisoned[5, 1] = bad
    norm.update(poisoned)
    norm.update(torch.randn(8, 2))
    assert not norm.finite
    assert torch.isfinite(norm.mean).all()
    assert norm.count.item() == 16


def test_a_norm_that_does_not_learn_clips_in_the_observations_own_units() -> None:
    norm = RunningNorm(2, clip=5.0, learns=False)
    norm.update(torch.full((8, 2), 3.0))
    norm.pool(norm.moments(), ProcessGroup(0, 2))  # nothing to add up, and nobody is asked
    torch.testing.assert_close(norm(torch.tensor([[0.5, -70.0]])), torch.tensor([[0.5, -5.0]]))
    assert norm.finite
    norm.update(torch.tensor([[math.nan, 0.0]]))
    assert not norm.finite


def test_running_norm_goes_on_the_same_after_loading() -> None:
    norm, copy = RunningNorm(3, clip=5.0), RunningNorm(3, clip=5.0)
    norm.update(2.0 + torch.randn(50, 3))
    copy.load_state_dict(norm.state_dict())
    x = torch.randn(4, 3)
    assert torch.equal(copy(x), norm(x))


def test_schedule_is_linear_between_points_and_constant_outside() -> None:
    points = [SchedulePoint(0, 0.8), SchedulePoint(10, 0.4), SchedulePoint(20, 0.2)]
    values = [scheduled(points, Position(samples)) for samples in (-1, 0, 5, 10, 15, 20, 99)]
    assert values == pytest.approx([0.8, 0.8, 0.6, 0.4, 0.3, 0.2, 0.2])
    assert scheduled(points[:1], Position(7)) == 0.8


def test_std_starts_at_the_first_point_and_stays_within_its_bounds() -> None:
    agent = Agent(6, 7, 2, small_algo(std=[SchedulePoint(0, 0.6)]), CPU)
    assert agent.actor.std.tolist() == pytest.approx([0.6, 0.6])
    agent.actor.bound_std(0.05, 0.3)
    assert agent.actor.std.tolist() == pytest.approx([0.3, 0.3])
    agent.actor.spread.state_independent_scale.data.fill_(-9.0)
    agent.actor.bound_std(0.05, 0.3)
    assert agent.actor.std.tolist() == pytest.approx([0.05, 0.05])


def test_a_floor_above_the_schedule_is_refused() -> None:
    with pytest.raises(ConfigError, match="std_floor"):
        Agent(6, 7, 2, small_algo(std_floor=0.9), CPU)


def test_last_layer_gain_scales_the_first_actions() -> None:
    observation = torch.randn(512, 6)
    sizes = []
    for gain in (0.1, 1.0):
        torch.manual_seed(3)
        agent = Agent(6, 7, 2, small_algo(last_layer_gain=gain), CPU)
        sizes.append(agent.actor.mlp(observation).std().item())
    assert sizes[1] / sizes[0] == pytest.approx(10.0, rel=1e-3)


def test_bf16_networks_agree_with_fp32_within_its_precision() -> None:
    torch.manual_seed(2)
    exact = Agent(6, 7, 2, small_algo(autocast="fp32"), CPU)
    rounded = Agent(6, 7, 2, small_algo(autocast="bf16"), CPU)
    rounded.load_state_dict(exact.state_dict())
    assert rounded.observation_dtype == torch.bfloat16
    x = torch.randn(256, 6)
    values, reference = (
        rounded.critic(torch.nn.functional.pad(x, (0, 1)).bfloat16()),
        exact.critic(torch.nn.functional.pad(x, (0, 1)).bfloat16().float()),
    )
    assert values.dtype == torch.float32
    assert (values - reference).abs().max().item() < 0.02 * reference.abs().max().item() + 0.02


def test_compute_dtype_follows_the_request() -> None:
    assert compute_dtype("fp32", CPU) == torch.float32
    assert compute_dtype("bf16", CPU) == torch.bfloat16
    assert compute_dtype("auto", CPU) in (torch.float32, torch.bfloat16)


def test_bf16_is_left_where_its_rounding_is_a_good_part_of_the_spread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    agent = Agent(6, 7, 2, small_algo(autocast="auto", fp32_below=0.2), CPU)
    for std, dtype in ((0.3, torch.bfloat16), (0.1, torch.float32), (0.3, torch.float32)):  # there is no way back
        agent.choose_dtype(std)
        assert agent.observation_dtype == agent.actor.mlp.dtype == dtype
        assert agent.critic.dtype == torch.bfloat16
    asked = Agent(6, 7, 2, small_algo(autocast="bf16", fp32_below=0.2), CPU)
    asked.choose_dtype(0.05)
    assert asked.observation_dtype == torch.bfloat16  # as asked for


def test_deterministic_policy_is_the_mean_action_of_the_agent() -> None:
    config = small_algo()
    agent = Agent(6, 7, 2, config, CPU)
    raw = 4.0 + 3.0 * torch.randn(64, 6)
    agent.policy_norm.update(raw)
    policy = Policy.build(6, 2, config)
    policy.norm.load_state_dict(agent.policy_norm.state_dict())
    policy.mlp.load_state_dict(agent.actor.mlp.state_dict())
    torch.testing.assert_close(policy(raw), agent.actor.mlp(agent.policy_norm(raw)))
