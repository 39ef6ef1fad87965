"""Pauses between serves: how long, where the ball is, what is seen of it, and who is charged with a fall."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.upgrade import upgrade_state
from pace.task.env import TableTennisEnv
from pace.task.game import Outcome
from pace.task.pauses import PauseBall
from tests.helpers.fakes import config

N = 6
DT = 0.02
QUIET = ("engine=native", "randomization=none", "serve.random_phase=false")


def make(kind: str, *overrides: str) -> TableTennisEnv:
    shares = ",".join(f"{name.name.lower()}:{float(name.name.lower() == kind)}" for name in PauseBall)
    return TableTennisEnv(config(*QUIET, f"serve.pause_ball={{{shares}}}", *overrides), N, "cpu", 3)


def end_serves(env: TableTennisEnv) -> None:
    env.game.clock.time.fill_(env.config.serve.max_duration)
    env.worlds.ball.position[:, 2] = 1.0  # in the air
    step(env)


def step(env: TableTennisEnv) -> None:
    """A control step of robots that are held up: their bases stay where they are."""
    start = env.worlds.engine.qpos_path[:, -1].clone()
    env.advance(torch.zeros(N, 21))
    env.worlds.engine.reset(torch.ones(N, dtype=torch.bool), start, torch.zeros(N, 27))


def played(env: TableTennisEnv, longest: int) -> Tensor:
    """Control steps (N,) from the end of a serve to the next launch, each ended and begun once."""
    end_serves(env)
    assert env.serve_over.all()
    steps = torch.where(env.game.ends.next_serve, 0, -1)
    for count in range(1, longest + 1):
        step(env)
        assert not (env.serve_over & (steps < 0)).any()
        assert not (env.game.ends.next_serve & (steps >= 0)).any()
        steps = torch.where(env.game.ends.next_serve, count, steps)
    return steps


def test_each_world_waits_for_a_time_in_the_range() -> None:
    env = make("hidden", "serve.pause=[0.2,0.6]")
    steps = played(env, 31)
    assert (steps >= 10).all()
    assert (steps <= 30).all()
    assert len(steps.unique()) > 1
    assert (env.game.clock.index == 1).all()
    assert env.game.clock.time.max() <= 0.42  # the clock of the next serve began with its launch


def test_while_it_waits_nothing_can_be_hit_and_the_outcome_stays() -> None:
    env = make("lies", "serve.pause=[0.5,0.5]")
    end_serves(env)
    outcome = env.serve_outcome.clone()
    assert (outcome == Outcome.MISS).all()
    for _ in range(24):
        step(env)
        assert env.game.pause.waiting.all()
        assert (env.game.referee.outcome == outcome).all()
        assert not env.predictor_valid.any()
        assert (env.task_state.target == env.game.idle_point).all()
        assert (env.game.clock.time == 0).all()
        assert env.reward.isfinite().all()
    step(env)
    assert env.game.ends.next_serve.all()
    assert (env.game.referee.outcome == Outcome.OPEN).all()


def test_a_ball_at_rest_stays_at_rest_until_it_is_served() -> None:
    env = make("lies", "serve.first_pause=[0.4,0.4]")
    rest = torch.tensor([0.0, 0.0, 0.02]).expand(N, 3)
    for _ in range(19):
        step(env)
        torch.testing.assert_close(env.worlds.ball.position, rest, atol=1e-4, rtol=0.0)
        assert env.worlds.ball.in_view.all()
        assert not env.serve_over.any()
    step(env)
    assert env.game.ends.next_serve.all()
    assert (env.worlds.ball.position[:, 0] == 1.35).all()
    assert (env.game.clock.index == 0).all()


def test_a_carried_ball_goes_straight_to_the_launch() -> None:
    env = make("carried", "serve.pause=[0.4,0.4]")
    end_serves(env)
    start, goal = env.worlds.ball.position.clone(), env._serves.launch[0].clone()
    for count in range(1, 20):
        step(env)
        share = count / 20
        torch.testing.assert_close(env.worlds.ball.position, start + share * (goal - start), atol=1e-4, rtol=0.0)
        torch.testing.assert_close(env.worlds.ball.velocity, (goal - start) / 0.4, atol=1e-3, rtol=0.0)
    step(env)
    assert torch.equal(env.worlds.ball.position, goal)


def test_a_hidden_ball_is_out_of_view_until_it_is_served() -> None:
    env = make("hidden", "serve.pause=[0.1,0.1]")
    end_serves(env)
    for _ in range(4):
        assert not env.worlds.ball.in_view.any()
        step(env)
    assert not env.worlds.ball.in_view.any()
    step(env)
    assert env.worlds.ball.in_view.all()


@pytest.mark.parametrize("sensing", ["paper", "mocap"])
def test_a_robot_that_saw_no_ball_yet_senses_none_until_a_frame_shows_one(sensing: str) -> None:
    env = make("hidden", "serve.first_pause=[0.1,0.1]", f"sensing={sensing}", "sensing.mocap.lost=0.0")
    env.sensing.ball_position.fill_(1.0)  # of the episode before
    env.reset_worlds(torch.ones(N, dtype=torch.bool))
    for _ in range(5):
        assert not env.worlds.ball.in_view.any()
        assert env.sensing.ball_position.abs().max() == 0.0
        assert not env.sensing.ball_new.any()
        assert bool((env.sensing.ball_age > 999.0).all())
        assert not env.actor.track.something_to_hit.any()
        step(env)
    for _ in range(3):  # delay and jitter are below 2 control steps
        step(env)
    torch.testing.assert_close(env.sensing.ball_position, env.worlds.ball.position, atol=0.4, rtol=0.0)
    assert bool((env.sensing.ball_age < 0.05).all())
    assert env.actor.track.something_to_hit.all()


def test_a_fall_in_a_pause_ends_the_episode_and_no_serve() -> None:
    env = make("hidden", "serve.pause=[1.0,1.0]", "serve.first_pause=[0.0,0.0]")
    end_serves(env)
    env.pop_statistics()
    qpos = env.worlds.engine.qpos_path[:, -1].clone()
    qpos[2, 2] = 0.2
    env.worlds.engine.reset(torch.ones(N, dtype=torch.bool), qpos, torch.zeros(N, 27))
    step(env)
    assert env.terminated.tolist() == [world == 2 for world in range(N)]
    assert not env.serve_over.any()
    sums = env.pop_statistics()
    assert (float(sums["falls"]), float(sums["episodes"]), float(sums["serves"])) == (1.0, 1.0, 0.0)
    env.reset_worlds(env.terminated)
    assert env.game.pause.waiting.tolist() == [world != 2 for world in range(N)]
    assert bool(env.worlds.ball.in_view[2])


def test_a_pause_is_saved_and_resumed() -> None:
    env, other = (make("carried", "serve.pause=[0.4,0.8]") for _ in range(2))
    end_serves(env)
    step(env)
    other.load_state_dict(env.state_dict())
    for _ in range(45):
        step(env)
        step(other)
        assert torch.equal(env.worlds.ball.position, other.worlds.ball.position)


def test_the_state_of_an_older_version_has_no_pauses() -> None:
    env, other = (make("lies") for _ in range(2))
    step(env)
    state = env.state_dict()
    new = [name for name in state if name.startswith(("game.pause.", "serves.")) or name == "worlds.in_view"]
    old = {name: value for name, value in state.items() if name not in new}
    assert len(new) == 8
    old["sensing._line"] = old["sensing._line"][..., :8]  # as it was, for its own upgrade
    old["statistics.sums"] = old["statistics.sums"][:-3]
    other.load_state_dict(upgrade_state({"processes": [{"env": old}]}, 2)["processes"][0]["env"])
    assert other.worlds.ball.in_view.all()
    for _ in range(3):
        step(env)
        step(other)
    assert torch.equal(env.worlds.ball.position, other.worlds.ball.position)


def test_pauses_that_cannot_be_used_are_errors() -> None:
    with pytest.raises(ConfigError, match=r"serve\.pause: -1\.0 is below 0"):
        config("serve.pause=[-1.0,2.0]")
    with pytest.raises(ConfigError, match=r"serve\.pause_ball: the shares .* sum to 1"):
        config("serve.pause_ball.lies=0.5")
    with pytest.raises(ConfigError, match=r"serve\.pause_ball needs exactly carried, hidden, lies"):
        config("+serve.pause_ball.flies=0.0")
