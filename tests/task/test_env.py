"""The environment on real worlds: contract, determinism, resets, the order of a step, resume, TorchRL."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

from pace.config.base import ConfigError
from pace.rl import make_env
from pace.task.env import TableTennisEnv
from pace.task.game import Outcome
from tests.helpers.fakes import config
from tests.helpers.hits import aim_at_paddle

N = 8


def make(seed: int = 1, *overrides: str) -> TableTennisEnv:
    return TableTennisEnv(config("engine=native", *overrides), N, "cpu", seed)


@pytest.fixture(scope="module")
def shared() -> TableTennisEnv:
    return make()


def play(env: TableTennisEnv, steps: int, seed: int = 0) -> list[Tensor]:
    """Random actions with resets; what the learner would see at each step."""
    generator = torch.Generator().manual_seed(seed)
    seen = []
    for _ in range(steps):
        env.advance(0.5 * torch.randn(N, 21, generator=generator))
        seen.append(torch.cat((env.policy_observation, env.critic_observation, env.reward.unsqueeze(1)), dim=1))
        env.reset_worlds(env.terminated | env.truncated)
    return seen


def test_torchrl_specs(shared: TableTennisEnv) -> None:
    check_env_specs(shared)
    assert shared.action_spec.shape == (N, 21)
    assert shared.observation_spec["policy"].shape == (N, 450)
    assert shared.observation_spec["critic"].shape == (N, 107)
    assert set(shared.done_keys) == {"done", "terminated", "truncated"}


def test_torchrl_rollout_and_reset(shared: TableTennisEnv) -> None:
    rollout = shared.rollout(6, break_when_any_done=False)
    assert rollout.batch_size == (N, 6)
    assert rollout["next", "reward"].shape == (N, 6, 1)
    torch.testing.assert_close(rollout["policy"][:, 1:], rollout["next", "policy"][:, :-1])


def test_torchrl_collector(shared: TableTennisEnv) -> None:
    collector = Collector(shared, shared.rand_action, frames_per_batch=4 * N, total_frames=8 * N)
    batches = [batch["policy"].shape for batch in collector]
    assert batches == [(N, 4, 450)] * 2


def test_the_papers_observations() -> None:
    env = make(1, "experiment=paper", "engine=native")
    assert env.policy_observation.shape == (N, 82 * 5)
    assert env.critic_observation.shape == (N, 93 * 5)
    play(env, 2)
    assert env.policy_observation.isfinite().all()


def test_a_seed_repeats_a_run_and_another_does_not() -> None:
    first, second, other = (play(make(seed), 12) for seed in (5, 5, 6))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert not torch.equal(first[0], other[0])


def test_set_seed(shared: TableTennisEnv) -> None:
    runs = []
    for _ in range(2):
        shared.set_seed(9)
        shared.reset()
        runs.append(play(shared, 3)[-1])
    assert torch.equal(runs[0], runs[1])


def test_state_dict_resumes_exactly(shared: TableTennisEnv) -> None:
    play(shared, 5)
    state = shared.state_dict()
    expected = play(shared, 30)
    other = make(77)
    other.load_state_dict(state)
    resumed = play(other, 30)
    assert all(torch.equal(a, b) for a, b in zip(expected, resumed, strict=True))


def test_reset_by_mask_touches_only_masked_worlds(shared: TableTennisEnv) -> None:
    play(shared, 4)
    mask = torch.arange(N) % 3 == 0
    policy, critic = shared.policy_observation.clone(), shared.critic_observation.clone()
    qpos, ball = shared.worlds.engine.qpos_path[:, -1].clone(), shared.worlds.ball.position.clone()
    track = shared.predictor_input.clone()
    shared.reset_worlds(mask)
    pairs = (
        (policy, shared.policy_observation),
        (critic, shared.critic_observation),
        (qpos, shared.worlds.engine.qpos_path[:, -1]),
        (ball, shared.worlds.ball.position),
        (track, shared.predictor_input),
    )
    for before, after in pairs:
        assert torch.equal(before[~mask], after[~mask])
        assert not torch.equal(before[mask], after[mask])
    frames = shared.policy_observation.view(N, 5, 90)[mask]
    assert torch.equal(frames, frames[:, :1].expand_as(frames))
    assert not shared.task_state.action[mask].any()


def test_an_empty_mask_changes_nothing(shared: TableTennisEnv) -> None:
    before = shared.state_dict()
    shared.reset_worlds(torch.zeros(N, dtype=torch.bool))
    after = shared.state_dict()
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, rtol=0, atol=0, equal_nan=True, msg=name)


def test_starts_lie_in_the_configured_ranges() -> None:
    env = make()
    base, reset = env.worlds.robot.base_position, env.config.reset
    assert bool(((base[:, 0] >= reset.base_x[0]) & (base[:, 0] <= reset.base_x[1])).all())
    torch.testing.assert_close(env.worlds.ball.position[:, 0], torch.full((N,), 1.35))
    assert not env.game.clock.time.any()
    assert bool((env.game.referee.outcome == Outcome.OPEN).all())


def test_an_episode_may_begin_in_the_middle_of_a_serve() -> None:
    env = make(1, "serve.head_start=[0.1,0.3]")
    env.reset_worlds(torch.ones(N, dtype=torch.bool))
    way = 1.35 - env.worlds.ball.position[:, 0]
    assert 0.1 * 4.5 < way.min() < way.max() < 0.3 * 6.5  # m, of serves of 5.0 to 6.5 m/s that the air slows down
    assert len(way.unique()) == N
    assert bool((env.game.referee.outcome == Outcome.OPEN).all())
    track = env.predictor_input.view(N, -1, 3)[:, -1, 0]
    torch.testing.assert_close(track, env.worlds.ball.position[:, 0], atol=0.1, rtol=0.0)  # noise and delay
    finish_serve(env, torch.arange(N) == 1)
    assert float(env.worlds.ball.position[1, 0]) == pytest.approx(1.35)  # the next one is served


def test_a_fall_terminates_and_the_serve_counts_as_a_fall() -> None:
    env = make()
    qpos = env.worlds.engine.qpos_path[:, -1].clone()
    qpos[2, 2], qpos[2, 3:7] = 0.2, torch.tensor([0.7071068, 0.0, -0.7071068, 0.0])  # on its back, above the floor
    env.worlds.reset_robot(torch.arange(N) == 2, qpos, torch.zeros(N, 27))
    env.pop_statistics()
    env.advance(torch.zeros(N, 21))
    assert env.terminated.tolist() == [i == 2 for i in range(N)]
    assert int(env.serve_outcome[2]) == Outcome.FALL
    sums = {name: float(value) for name, value in env.pop_statistics().items()}
    assert (sums["falls"], sums["episodes"], sums["serves"], sums["outcome/fall"]) == (1.0, 1.0, 1.0, 1.0)
    assert sums["reward/fall"] == pytest.approx(-1000 * 0.02 * 0.2)
    assert sums["steps"] == N


def finish_serve(env: TableTennisEnv, worlds: Tensor) -> None:
    """Let the ball of these worlds fall to the floor far away."""
    env.worlds.ball.position[worlds] = torch.tensor([-3.0, 1.5, 0.05])
    env.worlds.ball.velocity[worlds] = torch.tensor([0.0, 0.0, -1.0])
    env.advance(torch.zeros(N, 21))


def test_the_next_serve_begins_at_once_and_the_fifth_truncates() -> None:
    env = make()
    env.reset_worlds(torch.ones(N, dtype=torch.bool))
    world = torch.arange(N) == 1
    for serve in range(4):
        env.worlds.ball.position[world] = torch.tensor([-3.0, 1.5, 1.0])
        env.advance(torch.zeros(N, 21))  # the robot has seen it there
        finish_serve(env, world)
        assert env.serve_over.tolist() == world.tolist()
        assert int(env.serve_outcome[1]) == Outcome.MISS
        assert not env.truncated.any()
        assert float(env.game.clock.index[1]) == serve + 1
        assert float(env.worlds.ball.position[1, 0]) == pytest.approx(1.35)
        env.advance(torch.zeros(N, 21))  # motion capture is late
        track = env.predictor_input[1].view(5, 3)
        assert float(track[0, 0]) == pytest.approx(1.3, abs=0.07)
        assert torch.equal(track, track[:1].expand(5, 3))
    finish_serve(env, world)
    assert env.truncated.tolist() == world.tolist()
    assert not env.terminated.any()
    # the last observation is that of a further serve: what the value of a truncated episode should be taken from
    ball = env.critic_observation[1, env.critic_layout["ball_position"]]
    assert float(ball[0]) == pytest.approx(1.35)
    assert float(env.critic_observation[1, env.critic_layout["episode_progress"]]) == 1.0
    env.reset_worlds(env.truncated)
    assert float(env.game.clock.index[1]) == 0.0


def test_warmup_serves_are_not_counted() -> None:
    env = make(1, "serve=mixed")
    env.warmup_serves = 2
    everyone = torch.ones(N, dtype=torch.bool)
    counts = []
    for _ in range(3):
        finish_serve(env, everyone)
        counts.append(float(env.pop_statistics()["serves"]))
    assert counts == [0.0, 0.0, N]


def test_a_hit_is_seen_forecast_and_paid_in_its_step() -> None:
    env = make(2, "reset=evaluation", "randomization=none", "sensing=clean")
    aim_at_paddle(env)
    env.advance(torch.zeros(N, 21))
    hits = env.game.referee.hit_now
    assert int(hits.sum()) >= N - 1
    returns = env.game.returns
    assert bool(returns.landing[hits].isfinite().all())
    terms = dict(zip(env.rewards.names, env.rewards.values, strict=True))
    distance = (returns.landing[:, :2] - torch.tensor([1.15, 0.0])).norm(dim=1)
    torch.testing.assert_close(terms["predicted_landing"][hits], (3.0 - distance)[hits])
    assert bool((terms["arrival"][hits] > 0.5).all())
    assert bool((terms["contact"][hits] > 0.0).all())
    env.advance(torch.zeros(N, 21))
    terms = dict(zip(env.rewards.names, env.rewards.values, strict=True))
    for name in ("predicted_landing", "arrival", "contact"):
        assert not terms[name].any(), name


def test_a_ball_on_the_trunk_is_lost_and_pays_for_no_hit() -> None:
    env = make(2, "reset=evaluation", "randomization=none", "sensing=clean")
    env.game.referee.own_bounces.fill_(1)
    ball, base = env.worlds.ball, env.worlds.robot.base_position
    ball.position.copy_(base + torch.tensor([0.25, 0.0, 0.1]))
    ball.velocity.copy_(torch.tensor([-6.0, 0.0, 0.0]))
    env.advance(torch.zeros(N, 21))
    assert (env.worlds.ball.events.body == 1).all()
    assert (ball.velocity[:, 0] > 3.0).all()
    assert (env.game.referee.outcome == Outcome.BODY).all()
    assert not env.game.target.something_to_hit.any()
    aim_at_paddle(env)
    for _ in range(2):
        env.advance(torch.zeros(N, 21))
        assert not env.game.referee.hit.any()
        terms = dict(zip(env.rewards.names, env.rewards.values, strict=True))
        for name in ("predicted_landing", "predicted_net_height", "success", "arrival", "contact", "paddle_to_target"):
            assert not terms[name].any(), name
    ball.position[:, 2] = 0.05
    env.advance(torch.zeros(N, 21))
    counts = env.pop_statistics()
    assert (float(counts["serves"]), float(counts["outcome/body"]), float(counts["hits"])) == (N, N, 0)


def test_the_flight_after_a_hit_ends_where_its_forecast_said() -> None:
    env = make(2, "reset=evaluation", "randomization=none", "serve=mixed")
    aim_at_paddle(env)
    env.advance(torch.zeros(N, 21))
    hits, landing = env.game.referee.hit_now.clone(), env.game.returns.landing.clone()
    assert hits.any()
    lands_opponent = env.game.returns.lands_opponent.clone()
    outcome = torch.full((N,), -1)
    touchdown = torch.full((N, 3), torch.nan)
    for _ in range(90):
        events = env.worlds.ball.events
        env.advance(torch.zeros(N, 21))
        first = events.own_bounce + events.opponent_bounce > 0
        new = first & touchdown[:, 0].isnan()
        touchdown[new] = events.bounce_position[new]
        outcome = torch.where((outcome < 0) & env.serve_over & ~env.terminated, env.serve_outcome, outcome)
        if bool((outcome >= 0).all()):
            break
    on_table = hits & (env.game.returns.landing[:, 2] > 0.7) & (outcome >= 0)
    torch.testing.assert_close(touchdown[on_table], landing[on_table], atol=2e-3, rtol=0)
    decided = hits & (outcome >= 0)
    for other in (
        Outcome.FALL,
        Outcome.DOUBLE_HIT,
        Outcome.BODY,
        Outcome.TABLE_TOUCH,
        Outcome.FREE_HAND,
    ):  # not in the forecast
        decided &= outcome != other
    assert torch.equal((outcome == Outcome.SUCCESS)[decided], lands_opponent[decided])


def test_physics_runs_on_sensible_numbers(shared: TableTennisEnv) -> None:
    seen = play(shared, 40)
    assert all(bool(values.isfinite().all()) for values in seen)
    assert shared.first_bad() is None


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda env: env.sensing._line[5].fill_(torch.nan), "world 5 is not finite"),
        (lambda env: env.task_state.action[3].fill_(torch.nan), "reward term 'action_rate' of world 3 is not finite"),
    ],
)
def test_a_nan_names_world_and_term(spoil: Any, message: str) -> None:
    env = make()
    spoil(env)
    env.advance(torch.zeros(N, 21))
    bad = env.first_bad()
    assert bad is not None
    assert message in bad


def test_the_action_is_scaled_clipped_and_remembered(shared: TableTennisEnv) -> None:
    shared.advance(torch.full((N, 21), 100.0))
    assert float(shared.task_state.action.max()) == shared.config.robot.action_clip
    shared.reset_worlds(torch.ones(N, dtype=torch.bool))
    action = 0.1 * torch.arange(21.0).repeat(N, 1)
    shared.advance(action)
    torch.testing.assert_close(shared.worlds.actuation.held[:, 0], shared.worlds.nominal + 0.25 * action)
    frame = shared.policy_observation.view(N, 5, 90)[:, -1]
    torch.testing.assert_close(frame[:, shared.policy_layout["previous_action"]], action)


def test_make_env_and_wrong_input() -> None:
    env = make_env(4, engine="native", device="cpu", seed=3, overrides=["serve=long", "reward=paper"])
    assert env.batch_size == (4,)
    assert env.config.serve.name == "long"
    with pytest.raises(ConfigError, match="num_worlds must be at least 1"):
        make_env(0, engine="native", device="cpu")
    with pytest.raises(ConfigError, match=r"unknown reward term 'reward.terms.jump'"):
        make_env(2, engine="native", device="cpu", overrides=["+reward.terms.jump={weight: 1.0}"])
    with pytest.raises(ConfigError, match=r"observation.policy: unknown name 'apex'"):
        make_env(2, engine="native", device="cpu", overrides=["observation.policy=[apex]"])
