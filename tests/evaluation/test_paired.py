"""Two policies on the same serves: the serves, intervals of pairs against closed forms and made-up data."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pace.evaluation.paired import compare_pairs, compare_records, mcnemar, newcombe, play_listed
from pace.evaluation.records import COLUMNS, C, wilson
from pace.rl.policies import TaskPolicy, built_in_policy
from pace.task.game import Outcome

QUICK = ["engine.physics_dt=0.02", "engine=native", "engine.threads=1", "serve.max_duration=0.9"]


def flailing(policy: TaskPolicy) -> TaskPolicy:
    """A policy whose robots fall, at other times than those that stand still."""
    return TaskPolicy(policy.config, lambda seen: torch.full((len(seen), 21), 1.5), policy.predictor, "flailing")


def test_serves_do_not_depend_on_what_the_robots_do() -> None:
    zero = built_in_policy("zero", 1)
    given = ("short", 12, 3, "cpu")
    first = play_listed(zero, *given, 5, QUICK, warmup_serves=1)
    second = play_listed(flailing(zero), *given, 5, QUICK, warmup_serves=1)
    assert first.shape == (3, 4, len(COLUMNS))
    assert float(second[..., C["fall"]].sum()) > 0
    assert not torch.equal(first[..., C["fall"]], second[..., C["fall"]])
    assert torch.equal(first[..., :3], second[..., :3])
    assert first[..., C["ball"]].tolist() == second[..., C["ball"]].tolist() == [[2, 3, 4, 5]] * 3
    launches = first[..., :3].reshape(-1, 3)
    assert len(launches.unique(dim=0)) == 12  # none is repeated
    other = play_listed(zero, *given, 6, QUICK, warmup_serves=1)
    assert not torch.equal(first[..., :3], other[..., :3])


def test_balls_are_paired_by_world_and_number() -> None:
    first, second = torch.zeros(2, 2, len(COLUMNS)), torch.zeros(2, 2, len(COLUMNS))
    first[..., C["ball"]] = torch.tensor([[3.0, 4.0], [3.0, 4.0]])
    second[..., C["ball"]] = torch.tensor([[3.0, 4.0], [4.0, 5.0]])  # the third ball of world 1 missed the table
    second[..., C["hit"]] = torch.tensor([[1.0, 0.0], [1.0, 1.0]])
    second[0, 0, C["outcome"]] = Outcome.SUCCESS
    found = compare_records(first, second)
    assert (found["hit"].serves, found["hit"].only, found["hit"].shares[1]) == (3, (0, 2), pytest.approx(2 / 3))
    assert (found["success"].only, found["success"].difference) == ((0, 1), pytest.approx(1 / 3))


def test_newcombes_interval() -> None:
    low, high = newcombe(36, 2, 12, 0)
    (one, one_high), (other, other_high) = wilson(38, 50), wilson(48, 50)
    phi = -24 / math.sqrt(38 * 12 * 48 * 2)  # (36 * 0 - 2 * 12) / ...: negative, not corrected
    down, up = 0.96 - other, one_high - 0.76
    assert low == pytest.approx(0.2 - math.sqrt(down**2 - 2 * phi * down * up + up**2))
    down, up = 0.76 - one, other_high - 0.96
    assert high == pytest.approx(0.2 + math.sqrt(down**2 - 2 * phi * down * up + up**2))
    assert newcombe(36, 12, 2, 0) == pytest.approx((-high, -low))
    never = wilson(0, 50)[1]  # without a difference between pairs the interval has a width all the same
    for counts in ((0, 0, 0, 50), (50, 0, 0, 0)):
        assert newcombe(*counts) == pytest.approx((-never, never))
    assert all(math.isnan(bound) for bound in newcombe(0, 0, 0, 0))


def test_the_interval_holds_the_truth_in_95_of_100_cases() -> None:
    generator, covered = np.random.default_rng(2), []
    for shares in ([0.9, 0.01, 0.04, 0.05], [0.5, 0.1, 0.2, 0.2], [0.05, 0.3, 0.35, 0.3]):
        for counts in generator.multinomial(400, shares, 1000):
            low, high = newcombe(*(int(count) for count in counts))
            covered.append(low <= shares[2] - shares[1] <= high)
    assert 0.935 < np.mean(covered) < 0.97


def test_mcnemar_is_a_fair_coin() -> None:
    stats = pytest.importorskip("scipy.stats")
    for first, second in ((0, 0), (3, 3), (0, 8), (12, 2), (40, 61), (500, 400)):
        expected = stats.binomtest(first, first + second).pvalue if first + second else 1.0
        assert mcnemar(first, second) == mcnemar(second, first) == pytest.approx(expected, rel=1e-9)


def test_serves_of_one_world_that_fail_together_widen_the_interval_by_world() -> None:
    world = torch.arange(50).repeat_interleave(20)
    first = torch.zeros(1000, dtype=torch.bool)
    spread, together = torch.zeros_like(first), torch.zeros_like(first)
    spread[::10] = True  # 100 successes, two in each world
    together[:100] = True  # 100 successes, all in five worlds
    even, uneven = compare_pairs(first, spread, world), compare_pairs(first, together, world)
    assert (even.low, even.high) == (uneven.low, uneven.high)
    assert even.by_world == pytest.approx(0.0, abs=1e-12)
    by_hand = 1.959964 * math.sqrt(50 / 49 * (5 * 18.0**2 + 45 * 2.0**2)) / 1000
    assert uneven.by_world == pytest.approx(by_hand, rel=1e-6)
