"""Worlds of the task whose numbers go wrong: reset, counted, never seen by a learner, and shown."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pace.task.env import TableTennisEnv
from pace.task.outcome import Outcome
from tests.helpers.fakes import config

N, BAD = 6, 4


def make(*overrides: str) -> TableTennisEnv:
    return TableTennisEnv(config("engine=native", "engine.threads=1", *overrides), N, "cpu", 1)


def joint(env: TableTennisEnv) -> None:
    env.worlds.engine.state_tensors()["qpos"][BAD, 9] = torch.nan


def ball(env: TableTennisEnv) -> None:
    env.worlds.ball.position[BAD, 0] = torch.nan


def seen(env: TableTennisEnv) -> Tensor:
    return torch.cat((env.policy_observation, env.critic_observation, env.reward.unsqueeze(1)), dim=1)


@pytest.mark.parametrize(("spoil", "outcome"), [(joint, Outcome.FALL), (ball, Outcome.MISS)])
def test_a_world_that_diverges_is_reset_and_counted_and_never_seen(
    spoil: Callable[[TableTennisEnv], None], outcome: Outcome
) -> None:
    env, whole = make(), make()
    still = torch.zeros(N, 21)
    for _ in range(3):
        for each in (env, whole):
            each.advance(still)
    env.pop_statistics()
    whole.pop_statistics()
    spoil(env)
    env.advance(still)
    whole.advance(still)
    others = torch.arange(N) != BAD
    assert torch.equal(seen(env)[others], seen(whole)[others])
    assert bool(seen(env).isfinite().all())
    assert env.terminated.tolist() == [False] * BAD + [True, False]
    assert not bool(env.truncated.any())
    assert bool(env.serve_over[BAD])
    assert int(env.serve_outcome[BAD]) == outcome
    assert env.first_bad() is None
    env.reset_worlds(env.terminated | env.truncated)
    assert bool(seen(env).isfinite().all())
    counts = env.pop_statistics()
    assert float(counts["diverged"]) == 1.0
    assert all(bool(value.isfinite()) for value in counts.values())
    assert float(whole.pop_statistics()["diverged"]) == 0.0
    for _ in range(40):
        env.advance(still)
        env.reset_worlds(env.terminated | env.truncated)
        assert bool(seen(env).isfinite().all())
    assert float(env.pop_statistics()["diverged"]) == 0.0
    assert [replay.world for replay in env.replays()] == [BAD]
    assert env.replays() == []


def test_a_replay_ends_with_the_step_that_went_wrong() -> None:
    env = make("engine.remembered_steps=5")
    for number in range(8):
        if number == 6:
            before = env.worlds.robot.joint_position[BAD].clone()
            joint(env)
        env.advance(torch.zeros(N, 21))
        env.reset_worlds(env.terminated | env.truncated)
    (replay,) = env.replays()
    assert len(replay.qpos) == 4  # of the steps 4 to 8, without the last one, which was played after the reset
    torch.testing.assert_close(replay.qpos[-1, 7:], before)


def test_what_is_not_finite_for_another_reason_is_named_reset_and_replayed() -> None:
    env = make()
    env.advance(torch.zeros(N, 21))
    env.sensing._line[BAD].fill_(torch.nan)
    env.advance(torch.zeros(N, 21))
    assert f"of world {BAD} is not finite" in str(env.first_bad())
    assert env.terminated.tolist() == [False] * BAD + [True, False]
    env.reset_worlds(env.terminated)
    assert [replay.world for replay in env.replays()] == [BAD]
    assert env.first_bad() is None  # forgotten
    for _ in range(10):
        env.advance(torch.zeros(N, 21))
        assert bool(seen(env).isfinite().all())


def test_without_memory_there_is_no_replay() -> None:
    env = make("engine.remembered_steps=0")
    joint(env)
    env.advance(torch.zeros(N, 21))
    assert env.replays() == []
    assert float(env.pop_statistics()["diverged"]) == 1.0
