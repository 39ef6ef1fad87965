"""Layout, histories and masks of the observations, and what the actor must not see."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.task import PredictorConfig, TaskConfig
from pace.onboard.actor import Readings
from pace.onboard.kinematics import PaddleChain
from pace.predictor.network import predictor_slices
from pace.sim.sensing import Sensing
from pace.task.env import TableTennisEnv
from pace.task.history import History
from pace.task.observations import (
    CRITIC,
    POLICY,
    check_critic,
    check_policy,
    layout,
    width,
)
from pace.task.signals import ActorSignals
from tests.helpers.fakes import CPU, config, fake_state, fake_worlds
from tests.helpers.hits import aim_at_paddle

NO = torch.zeros(1, dtype=torch.bool)
YES = torch.ones(1, dtype=torch.bool)
IDLE = torch.tensor([-1.7, -0.3, 1.0])


@pytest.mark.parametrize(
    ("overrides", "policy", "critic"),
    [(("observation=paper",), 82, 93), (("observation=paddle_pose",), 90, 107), (("observation=memory",), 96, 110)],
)
def test_sizes(overrides: tuple[str, ...], policy: int, critic: int) -> None:
    names = config(*overrides).observation
    assert sum(width(POLICY[name].size, 21) for name in names.policy) == policy
    assert sum(width(CRITIC[name].size, 21) for name in names.critic) == critic


def test_layout_follows_the_order_of_the_names() -> None:
    columns = layout(["heading", "base_position", "joint_velocity"], POLICY, 21)
    assert columns == {"heading": slice(0, 2), "base_position": slice(2, 5), "joint_velocity": slice(5, 26)}


@pytest.mark.parametrize("name", ["ball_velocity", "apex", "paddle_touched", "base_linear_velocity"])
def test_privileged_names_are_refused_for_the_actor(name: str) -> None:
    with pytest.raises(ConfigError, match=f"unknown name '{name}' .privileged"):
        check_policy(replace(config(), observation=replace(config().observation, policy=["heading", name])))


def test_unknown_names_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"observation.critic: unknown name 'ball_colour'"):
        check_critic(["ball_colour"])
    with pytest.raises(ConfigError, match=r"add 'target_time' to predictor.outputs"):
        check_policy(config("observation=paddle_pose", "predictor=paper"))
    with pytest.raises(ConfigError, match=r"predictor.outputs"):
        predictor_slices(["apex", "spin"])
    with pytest.raises(ConfigError, match=r"predictor.outputs"):
        predictor_slices(["target"])


def test_predictor_slices() -> None:
    expected = {"target_time": slice(0, 1), "apex": slice(1, 4), "target": slice(4, 7)}
    assert predictor_slices(["target_time", "apex", "target"]) == expected


def test_history_is_oldest_first_and_filled_at_reset() -> None:
    kept = torch.zeros(2, 1)
    history = History(3, [lambda: kept, lambda: 10.0 * kept, lambda: kept > 2.0])  # kept, computed, of another type
    for step in range(1, 5):
        kept.fill_(float(step))
        history.push()
    assert history.observation[0].tolist() == [2.0, 20.0, 0.0, 3.0, 30.0, 1.0, 4.0, 40.0, 1.0]
    kept.fill_(7.0)
    history.fill(torch.tensor([False, True]))
    expected = [[2.0, 20.0, 0.0, 3.0, 30.0, 1.0, 4.0, 40.0, 1.0], [7.0, 70.0, 1.0] * 3]
    assert history.observation.tolist() == expected


def fake_paddle(base_position: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
    """A paddle that is always half a metre in front of the base and 0.3 m above it."""
    return base_position + torch.tensor([0.5, 0.0, 0.3]), torch.tensor([1.0, 0.0, 0.0]).expand_as(base_position)


def fake_actor(task: TaskConfig, output: Tensor | None) -> ActorSignals:
    worlds = fake_worlds(1)
    generator = torch.Generator().manual_seed(0)
    sensing = Sensing(task.sensing, 1, CPU, 0.02, worlds.nominal, generator)
    sensing.reset(YES, worlds.robot, worlds.ball.position)

    def predict(positions: Tensor) -> Tensor:
        assert output is not None
        return output.repeat(positions.shape[0], 1)

    predictor = predict if output is not None else None
    action = torch.zeros(1, 21)
    actor = ActorSignals(task, sensing, action, fake_paddle, predictor)
    actor.begin(YES)
    for x in (0.7, 0.6, 0.5):
        sensing.ball_position.copy_(torch.tensor([[x, 0.0, 1.1]]))
        actor.step()
    return actor


PREDICTION = torch.tensor([[-1.4, 0.1, 1.1, -1.6, 0.12, 1.05, 0.3]])


def test_predicted_quantities() -> None:
    actor = fake_actor(config("sensing=clean"), PREDICTION)
    torch.testing.assert_close(actor.apex, PREDICTION[:, :3])
    torch.testing.assert_close(actor.target, PREDICTION[:, 3:6])
    assert float(actor.time) == pytest.approx(0.3)
    # target + (-0.1, 0.6) - base (-1.8, 0.3)
    torch.testing.assert_close(actor.shift, torch.tensor([[0.1, 0.42]]))
    paddle = torch.tensor([[-1.3, 0.3, 1.0]])  # of the fake kinematics
    torch.testing.assert_close(POLICY["sensed_paddle_to_target"].function(actor), PREDICTION[:, 3:6] - paddle)


def test_shift_of_the_paper_uses_the_apex_and_a_clamped_target() -> None:
    task = config("sensing=clean", "reward=paper", "predictor=paper", "observation=paper")
    actor = fake_actor(task, PREDICTION[:, :3])
    torch.testing.assert_close(actor.shift, torch.tensor([[0.3, 0.4]]))
    torch.testing.assert_close(actor.target, torch.tensor([[-1.6, 0.1, 1.1]]))
    assert float(actor.time) == 0.0


def test_predictions_are_masked_while_nothing_is_to_hit() -> None:
    actor = fake_actor(config("sensing=clean"), PREDICTION)
    actor.sensing.ball_position.copy_(torch.tensor([[0.9, 0.0, 1.1]]))  # turned away
    actor.step()
    torch.testing.assert_close(actor.apex[0], IDLE)
    torch.testing.assert_close(actor.target[0], IDLE)
    assert float(actor.time) == 0.0
    torch.testing.assert_close(actor.shift, torch.tensor([[0.0, 0.0]]))  # base on its idle place
    assert float(POLICY["something_to_hit"].function(actor)) == 0.0


def test_without_a_predictor_its_quantities_are_zero() -> None:
    for task, output in ((config(), None), (config("predictor.enabled=false"), PREDICTION)):
        actor = fake_actor(task, output)
        for tensor in (actor.apex, actor.target, actor.time, actor.shift):
            assert not tensor.any()


def test_critic_sees_the_forecast_or_the_place_to_stand_by() -> None:
    state = fake_state()
    state.game.clock.time.fill_(0.1)
    state.derive()
    torch.testing.assert_close(state.apex, state.game.target.apex)
    assert float(state.arrival) == pytest.approx(0.58)
    torch.testing.assert_close(state.shift, torch.tensor([[0.1, 0.42]]))
    state.ball.velocity[:, 0] = 2.0
    state.derive()
    torch.testing.assert_close(state.apex[0], IDLE)
    assert float(state.arrival) == 0.0
    torch.testing.assert_close(state.shift, torch.tensor([[0.0, 0.0]]))


def test_critics_shift_of_the_paper_is_that_of_the_apex() -> None:
    state = fake_state(1, config("reward=paper"))
    torch.testing.assert_close(state.shift, torch.tensor([[0.3, 0.4]]))  # apex (-1.4, 0.1)
    torch.testing.assert_close(state.base_error, torch.tensor([[0.1, 0.4]]))  # x clamped to -1.6


# --- the whole environment --------------------------------------------------------------------------------------------


class TruePredictor:
    """Stands for a network: a fixed function of its input."""

    def __call__(self, positions: Tensor) -> Tensor:
        return torch.cat((positions[:, -3:] * 2.0, positions[:, :3], positions[:, 3:4].abs()), dim=1)


@pytest.fixture(scope="module")
def env() -> TableTennisEnv:
    env = TableTennisEnv(config("engine=native", "num_worlds=8"), 8, "cpu", 3, TruePredictor())
    for _ in range(4):
        env.advance(torch.zeros(8, 21))
    return env


def test_policy_frame_is_made_of_the_named_signals(env: TableTennisEnv) -> None:
    assert env.policy_observation.shape == (8, 450)
    assert env.critic_observation.shape == (8, 107)
    frame = env.policy_observation.view(8, 5, 90)[:, -1]
    columns = env.policy_layout
    torch.testing.assert_close(frame[:, columns["ball_position"]], env.sensing.ball_position)
    torch.testing.assert_close(frame[:, columns["predicted_apex"]], env.actor.apex)
    torch.testing.assert_close(env.predictor_input[:, -3:], env.sensing.ball_position)
    critic = env.critic_observation
    torch.testing.assert_close(critic[:, env.critic_layout["ball_velocity"]], env.worlds.ball.velocity)
    error = frame[:, columns["base_position"]] - critic[:, env.critic_layout["base_position"]]
    assert 0.0 < float(error.abs().max()) < 0.02


def policy_input(env: TableTennisEnv, change: Any = None) -> tuple[Tensor, Tensor]:
    """The actor's frame and the predictor's input of the same step, after ``change`` to the world."""
    state = env.state_dict()
    if change is not None:
        change(env)
    no_new_ball = torch.zeros(8, dtype=torch.bool)
    env.sensing.update(env.worlds.robot, env.worlds.ball.position, no_new_ball)
    env.actor.step()
    env._compute_truth()
    env._policy_history.push()
    frame, positions = env.policy_observation.clone(), env.predictor_input.clone()
    env.load_state_dict(state)
    return frame, positions


SHORT = ("engine=native", "engine.threads=1", "observation=memory", "serve.max_duration=0.4", "sensing=wide")


PAUSED = ("serve.pause=[0.0,0.2]", "serve.first_pause=[0.0,0.2]", "serve.pause_ball={lies:0.4,carried:0.3,hidden:0.3}")


@pytest.mark.parametrize("more", [(), PAUSED, ("sensing=mocap", *PAUSED)], ids=["wide", "pauses", "mocap"])
def test_the_actor_sees_launches_hits_and_resets_through_sensed_frames_alone(more: tuple[str, ...]) -> None:
    """Other modules, given only the readings, make the same policy observation, bit for bit."""
    env = TableTennisEnv(config(*SHORT, *more), 8, "cpu", 3, TruePredictor())
    names = (*Readings._fields, "base_shift_noise")
    sensing: Any = SimpleNamespace(**{name: getattr(env.sensing, name).clone() for name in names})
    action, everyone = env.task_state.action.clone(), torch.ones(8, dtype=torch.bool)
    chain = PaddleChain(env.worlds.model, env.worlds.spec.paddle)
    apart = ActorSignals(env.config, sensing, action, chain, TruePredictor())
    history = History(5, [partial(POLICY[name].function, apart) for name in env.config.observation.policy])

    def read() -> None:
        action.copy_(env.task_state.action)
        for name in names:
            getattr(sensing, name).copy_(getattr(env.sensing, name))

    apart.begin(everyone)
    history.fill(everyone)
    launches, begun, hits = 0, 0, 0
    for step in range(70):
        if step % 10 == 5:
            aim_at_paddle(env, slice(None, None, 2))
        env.advance(0.3 * torch.randn(8, 21))
        hits += int(env.game.referee.hit_now.sum())
        read()
        apart.step()
        history.push()
        assert torch.equal(history.observation, env.policy_observation), step
        launches += int(env.game.ends.next_serve.sum())
        done = env.terminated | env.truncated | (torch.arange(8) == step % 32)
        env.reset_worlds(done)
        begun += int(done.sum())
        read()
        apart.begin(done)
        history.fill(done)
        assert torch.equal(history.observation, env.policy_observation), step
    assert launches >= 16
    assert begun >= 16
    assert hits >= 8


def test_the_predictor_learns_from_no_step_in_which_the_old_ball_is_sensed() -> None:
    env = TableTennisEnv(config(*SHORT, "sensing.mocap_delay=[0.03,0.03]"), 16, "cpu", 3, TruePredictor())
    launches = 0
    for _ in range(60):
        env.advance(torch.zeros(16, 21))
        known = env.game.target.something_to_hit & env.actor.track.something_to_hit
        assert torch.equal(env.predictor_valid, known & (env.game.clock.time >= env.sensing.ball_age))
        new = env.game.ends.next_serve
        launches += int(new.sum())
        far = (env.sensing.ball_position - env.worlds.ball.position).norm(dim=1) > 0.5  # of the ball before
        assert not env.predictor_valid[new & far & ~env.game.ends.lost].any()
        env.reset_worlds(env.terminated)
    assert launches >= 8


def test_other_launches_under_the_same_sensed_frames_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = (TableTennisEnv(config(*SHORT), 8, "cpu", 3, TruePredictor()) for _ in range(2))
    monkeypatch.setattr(other.sensing, "update", lambda *_: other.sensing._sensed.copy_(one.sensing._sensed))
    assert torch.equal(one.policy_observation, other.policy_observation)
    different = 0
    for step in range(40):
        action = 0.3 * torch.randn(8, 21)
        if step % 7 == 0:
            other._start_serves(torch.arange(8) % 2 == 0, torch.arange(8) % 2 == 0)
        one.advance(action)
        other.advance(action)
        assert torch.equal(one.policy_observation, other.policy_observation), step
        different += int((one.game.ends.next_serve != other.game.ends.next_serve).sum())
    assert different >= 8


PRIVILEGED_ROBOT = (
    "joint_acceleration", "joint_torque", "base_quat", "base_linear_velocity", "paddle_position", "paddle_normal",
    "paddle_velocity", "foot_position", "foot_velocity", "foot_up", "foot_force", "body_contact", "head_position",
)  # fmt: skip


def _tensors(owner: object) -> dict[str, Tensor]:
    return {name: value for name, value in vars(owner).items() if isinstance(value, Tensor)}


def _scramble(tensor: Tensor) -> None:
    if tensor.dtype == torch.bool:
        tensor.logical_not_()
    elif tensor.is_floating_point():
        tensor.mul_(-1.7).add_(0.3)
    else:
        tensor.add_(1)


def privileged(env: TableTennisEnv) -> dict[str, Tensor]:
    """Every tensor of the true state that no sensor looks at."""
    ball = env.worlds.ball
    found = {f"robot.{name}": getattr(env.worlds.robot, name) for name in PRIVILEGED_ROBOT}
    found |= {"ball.velocity": ball.velocity, "ball.spin": ball.spin, "ball.near": ball.nearest_paddle_distance}
    for group in (ball.events, ball.forecast_result, ball.params, env.worlds.engine.params):
        found |= {f"{type(group).__name__}.{f.name}": getattr(group, f.name) for f in fields(group)}  # type: ignore[arg-type]
    for name, part in ((name, part) for name, part in vars(env.game).items() if hasattr(part, "__dict__")):
        found |= {f"game.{name}.{key}": value for key, value in _tensors(part).items() if key != "idle_point"}
    found |= {f"reward.{name}": value for name, value in _tensors(env.rewards).items()}
    for name in ("something_to_hit", "lost", "base_error", "foot_load", "foot_contact"):
        found[f"state.{name}"] = getattr(env.task_state, name)
    return found | {"truncated": env.truncated, "outcome": env.serve_outcome}


def test_no_privileged_quantity_reaches_the_actor(env: TableTennisEnv) -> None:
    expected, positions = policy_input(env)
    names = list(privileged(env))
    assert len(names) > 80
    for name in names:
        before = privileged(env)[name].clone()
        frame, track = policy_input(env, lambda env, name=name: _scramble(privileged(env)[name]))
        assert torch.equal(frame, expected), name
        assert torch.equal(track, positions), name
        privileged(env)[name].copy_(before)


@pytest.mark.parametrize("name", ["base_position", "joint_position", "joint_velocity", "heading", "projected_gravity"])
def test_what_sensors_see_does_reach_the_actor(env: TableTennisEnv, name: str) -> None:
    expected, _ = policy_input(env)
    tensor = getattr(env.worlds.robot, name)
    before = tensor.clone()
    frame, _ = policy_input(env, lambda env: tensor.add_(0.1))
    tensor.copy_(before)
    assert not torch.equal(frame, expected)


def test_the_actor_sees_the_ball_by_its_position_only(env: TableTennisEnv) -> None:
    expected, _ = policy_input(env)
    frame, _ = policy_input(env, lambda env: env.worlds.ball.position.add_(0.1))
    assert not torch.equal(frame, expected)


def test_predictor_config_matches_the_output(env: TableTennisEnv) -> None:
    outputs: PredictorConfig = env.config.predictor
    assert env.predictor_target.shape == (8, 7)
    columns = predictor_slices(outputs.outputs)
    torch.testing.assert_close(env.predictor_target[:, columns["apex"]], env.game.target.apex)
    left = env.game.target.time - env.game.clock.time
    torch.testing.assert_close(env.predictor_target[:, columns["target_time"]], left.unsqueeze(1))
