"""The task in the forms of other libraries, each trained for a few updates by its own learner."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils import env_checker
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics, TransformReward

import pace
from pace.config.base import ConfigError
from pace.interfaces import GymnasiumEnv, RslRlEnv
from pace.interfaces.rsl_rl_env import ENDLESS, longest_episode
from pace.rl.policies import load_predictor
from pace.runs.checkpoint import CheckpointError
from pace.task.env import TableTennisEnv
from tests.helpers.scripts import load_example

N = 4
#: Episodes of one serve of 0.4 s, so that worlds are truncated within a test.
SHORT = ("engine.threads=1", "serve.serves_per_episode=1", "serve.max_duration=0.4", "serve.random_phase=false")


def make(*overrides: str, worlds: int = N, **kind: Any) -> TableTennisEnv:
    return pace.make_env(worlds, "native", "cpu", overrides=[*SHORT, *overrides], **kind)


@pytest.fixture(scope="module")
def task() -> TableTennisEnv:
    return make()


@pytest.fixture
def env(task: TableTennisEnv) -> Iterator[GymnasiumEnv]:
    made = GymnasiumEnv(task)
    made.reset(seed=1)
    yield made
    made.close()


# --- the environment as one call --------------------------------------------------------------------------------------


def test_make_env_predicts_the_apex(task: TableTennisEnv) -> None:
    """Within 0.3 m of the true apex after ten sensed frames, in the worlds with something to hit."""
    task.generator.manual_seed(3)
    task.reset_worlds(torch.ones(N, dtype=torch.bool))
    for _ in range(10):
        task.advance(torch.zeros(N, 21))
    valid = task.predictor_valid
    assert int(valid.sum()) >= 2
    error = (task.actor.apex - task.predictor_target[:, :3])[valid].norm(dim=1)
    assert float(error.max()) < 0.3
    assert task.config.predictor.frames == load_predictor("campaign").config.frames


def test_a_predictor_is_trained_or_ones_own_or_none() -> None:
    own = make("predictor.frames=7", predictor=lambda frames: frames.new_ones(len(frames), 7))
    assert own.predictor_input.shape == (N, 21)
    silent = make(predictor=None)
    silent.advance(torch.zeros(N, 21))
    assert float(silent.actor.apex.abs().max()) == 0.0
    with pytest.raises(ConfigError, match=r"predictor.frames=7 configures a predictor, and predictor='campaign'"):
        make("predictor.frames=7")
    with pytest.raises(CheckpointError, match="did you mean campaign"):
        make(predictor="campain")
    assert make("experiment=ablation/no_predictor").predictor_input.shape == (N, 15)


# --- gymnasium --------------------------------------------------------------------------------------------------------


def test_gymnasiums_checks_that_a_vector_environment_can_pass(env: GymnasiumEnv) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env_checker.check_reset_seed_determinism(env)  # type: ignore[arg-type]
        env_checker.check_reset_options(env)  # type: ignore[arg-type]
        env_checker.check_reset_return_type(env)  # type: ignore[arg-type]


def test_make_vec_finds_it_and_wrappers_take_it() -> None:
    name = "pace.interfaces.gymnasium_env:pace/TableTennis-v0"
    env = gymnasium.make_vec(name, num_envs=N, device="cpu", overrides=list(SHORT))
    assert isinstance(env.unwrapped, GymnasiumEnv)
    wrapped = RecordEpisodeStatistics(TransformReward(env, lambda reward: 10.0 * reward))
    wrapped.reset(seed=1)
    infos = [wrapped.step(np.zeros((N, 21), np.float32))[4] for _ in range(25)]
    lengths = [info["episode"]["l"][info["_episode"]] for info in infos if "episode" in info]
    assert np.concatenate(lengths).tolist() == [20] * N  # 0.4 s


def test_a_world_that_is_done_begins_again_in_the_same_step(env: GymnasiumEnv) -> None:
    zero = np.zeros((N, 21), np.float32)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    for _ in range(19):
        before, _, terminated, truncated, info = env.step(zero)
        assert not (terminated | truncated).any()
        assert info == {}
    observation, reward, terminated, truncated, info = env.step(zero)
    assert truncated.all()
    assert reward.shape == (N,)
    assert info["_final_obs"].tolist() == [True] * N
    last = np.stack([final["policy"] for final in info["final_obs"]])
    frame = last.shape[1] // 5
    np.testing.assert_array_equal(last[:, : 4 * frame], before["policy"][:, frame:])  # its history is the old episode's
    assert not np.array_equal(observation["policy"][:, : 4 * frame], before["policy"][:, frame:])
    assert observation in env.observation_space
    assert {name: part.shape for name, part in observation.items()} == {"policy": (N, 450), "critic": (N, 107)}


def test_without_autoreset_the_caller_says_which_worlds_begin_again(task: TableTennisEnv) -> None:
    env = GymnasiumEnv(task, AutoresetMode.DISABLED, critic="info")
    env.reset(seed=1)
    zero = np.zeros((N, 21), np.float32)
    for _ in range(19):
        env.step(zero)
    last, _, _, truncated, info = env.step(zero)
    assert truncated.all()
    assert "final_obs" not in info
    assert info["critic"].shape == (N, 107)
    mask = np.array([True, False, False, True])
    begun, _ = env.reset(options={"reset_mask": mask})
    assert [np.array_equal(a, b) for a, b in zip(last, begun, strict=True)] == [False, True, True, False]
    with pytest.raises(ValueError, match=r"reset_mask must have the shape \(4,\), not \(3,\)"):
        env.reset(options={"reset_mask": mask[:3]})
    with pytest.raises(ValueError, match=r"actions must have the shape \(4, 21\), not \(21,\)"):
        env.step(zero[0])
    with pytest.raises(ConfigError, match="SAME_STEP or DISABLED"):
        GymnasiumEnv(task, AutoresetMode.NEXT_STEP)


def test_the_truth_of_a_world_that_is_done_is_in_its_final_info(task: TableTennisEnv) -> None:
    env = GymnasiumEnv(task, critic="info")
    env.reset(seed=1)
    for _ in range(19):
        env.step(np.zeros((N, 21), np.float32))
    _, _, _, _, info = env.step(np.zeros((N, 21), np.float32))
    final = info["final_info"]["critic"]
    assert final.shape == info["critic"].shape
    assert not np.array_equal(final, info["critic"])


def test_views_share_the_environments_memory_and_copies_do_not(task: TableTennisEnv) -> None:
    shared, own = GymnasiumEnv(task, copy=False), GymnasiumEnv(task)
    for env, same in ((shared, True), (own, False)):
        observation, _ = env.reset(seed=1)
        assert np.shares_memory(observation["policy"], task.policy_observation.numpy()) is same
        later = env.step(np.zeros((N, 21), np.float32))[0]
        assert np.array_equal(observation["policy"], later["policy"]) is same


@pytest.mark.slow
def test_ppo_in_the_manner_of_cleanrl_trains_on_it() -> None:
    example = load_example("ppo_gymnasium")
    settings = example.Settings(worlds=32, updates=3, steps=24, hidden=32)
    rewards = example.train(GymnasiumEnv(make(worlds=32)), settings)
    assert len(rewards) == 3
    assert np.isfinite(rewards).all()


# --- rsl_rl -----------------------------------------------------------------------------------------------------------


def test_rsl_rl_gets_copies_and_tells_time_outs(task: TableTennisEnv) -> None:
    env = RslRlEnv(task, log_every=20)
    assert (env.num_actions, env.max_episode_length) == (21, 20)
    before, _ = env.reset()
    kept = before["policy"].clone()
    with torch.inference_mode():
        for _ in range(19):
            _, _, done, extras = env.step(torch.zeros(N, 21))
            assert not done.any()
            assert "log" not in extras
        assert env.episode_length_buf.tolist() == [19] * N
        _, reward, done, extras = env.step(torch.zeros(N, 21))
    assert torch.equal(before["policy"], kept)
    assert done.all()
    assert extras["time_outs"].all()
    assert reward.shape == (N,)
    assert env.episode_length_buf.tolist() == [0] * N
    assert extras["log"]["/hit_rate"] == 0.0
    assert "/reward/success" in extras["log"]
    task.advance(torch.zeros(N, 21))  # outside of inference mode, too


def test_the_longest_episode_follows_from_the_serves(task: TableTennisEnv) -> None:
    serve = task.config.serve
    assert longest_episode(serve, 0.02) == 20
    assert longest_episode(replace(serve, pause=[0.1, 0.2], first_pause=[0.0, 0.1]), 0.02) == 35
    assert longest_episode(replace(serve, serves_per_episode=0), 0.02) == ENDLESS


@pytest.mark.slow
def test_rsl_rls_own_runner_trains_on_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runner = load_example("train_rsl_rl").make_runner(32, str(tmp_path), "cpu", 32, overrides=list(SHORT))
    first = {name: value.clone() for name, value in runner.alg.actor.state_dict().items()}
    runner.learn(2)
    later = runner.alg.actor.state_dict()
    assert any(not torch.equal(first[name], later[name]) for name in first if "mlp" in name)
    assert all(torch.isfinite(value).all() for value in later.values())
    assert "/success_rate" in capsys.readouterr().out
    assert (tmp_path / "model_1.pt").exists()
