"""The table of estimates: what stands in it is computed, saved, observed and exported, and nothing else is."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError, parse, require, to_dict
from pace.config.task import ObservationConfig, TaskConfig
from pace.config.training import TrainConfig, load_train_config
from pace.deploy.graph import DeployedPolicy, StateLayout
from pace.onboard.estimate import Estimate, Part
from pace.onboard.estimates import ESTIMATES, Entry, check, observed
from pace.predictor.network import PredictorNetwork
from pace.rl.agent import Policy
from pace.rl.policies import TaskPolicy, policy_size
from pace.sim.robot import build_model
from pace.task.env import TableTennisEnv
from pace.task.observations import POLICY, check_policy, width
from tests.helpers.fakes import config

DATA = Path(__file__).parent / "data"


@dataclass
class MeanConfig:
    """Numbers of an estimate that the package does not know."""

    gain: float

    def __post_init__(self) -> None:
        require(0 < self.gain <= 1, f"gain must lie in (0, 1], got {self.gain}")


class MeanBall(Estimate):
    """A running mean of where the ball is."""

    def __init__(self, config: MeanConfig, control_dt: float, joints: int) -> None:
        super().__init__(config, control_dt, joints)
        self.gain = config.gain

    @staticmethod
    def parts(joints: int) -> dict[str, Part]:
        return {"mean": Part(3, "m", "running mean of the ball's position, world frame")}

    def begin(self, ball_position: Tensor) -> Tensor:
        return 1.0 * ball_position

    def forward(self, state: Tensor, ball_position: Tensor) -> Tensor:
        return state + self.gain * (ball_position - state)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> TrainConfig:
    """A task whose policy observes the mean, while it is registered."""
    entry = Entry("mean_ball", MeanConfig, MeanBall, ("ball_position",), {"usual_ball": "mean"})
    monkeypatch.setitem(ESTIMATES, "mean", entry)
    return with_mean({"gain": 0.25})


def with_mean(numbers: dict[str, float]) -> TrainConfig:
    saved = to_dict(load_train_config(["algo.actor_hidden=[8]", "algo.autocast=fp32", "observation=memory"]))
    saved["observation"]["policy"].append("usual_ball")
    saved["observation"]["estimates"] = {"mean_ball": numbers}
    return parse(saved, TrainConfig)


def test_one_from_outside_is_observed_saved_and_reset(registered: TaskConfig) -> None:
    env = TableTennisEnv(registered, 3, "cpu", 1)
    expected = env.sensing.ball_position.clone()
    for _ in range(4):
        env.advance(torch.zeros(3, 21))
        expected += 0.25 * (env.sensing.ball_position - expected)
    columns = env.policy_layout["usual_ball"]
    seen = env.policy_observation.view(3, 5, -1)[:, -1, columns]
    torch.testing.assert_close(seen, expected)
    saved = env.state_dict()
    assert torch.equal(saved["mean.state"], seen)
    env.reset_worlds(torch.tensor([True, False, False]))
    assert torch.equal(env.actor.estimates["mean"][0], env.sensing.ball_position[0])
    env.load_state_dict(saved)
    assert torch.equal(env.actor.estimates["mean"], saved["mean.state"])


def test_one_from_outside_is_exported(registered: TrainConfig) -> None:
    network = Policy.build(policy_size(registered), 21, registered.algo)
    policy = TaskPolicy(registered, network.eval(), PredictorNetwork(registered.predictor), "fresh")
    graph = DeployedPolicy(policy, build_model(registered.robot, registered.engine, registered.ball.table))
    state = StateLayout(registered)
    readings = [torch.rand(2, size) for size in (3, 3, 3, 2, 21, 21, 3)]
    readings += [torch.rand(2, 1), torch.ones(2, 1)] * 2  # new frames of the base and of the ball
    with torch.no_grad():
        first = graph(*readings, torch.zeros(2, state.size))[-1]
        assert torch.equal(first[:, state.columns["mean"]], readings[6])
        later = [*readings[:6], readings[6] + 1.0, *readings[7:]]
        second = graph(*later, first)[-1]
    torch.testing.assert_close(second[:, state.columns["mean"]], readings[6] + 0.25)


def test_its_numbers_are_checked(registered: TrainConfig) -> None:
    assert width(POLICY["usual_ball"].size, 21) == 3
    check_policy(registered)
    for numbers, message in (
        ({"gain": 2.0}, r"observation\.estimates\.mean_ball: .*gain must lie in"),
        ({"gain": 0.1, "speed": 1.0}, r"observation\.estimates\.mean_ball: .*speed"),
    ):
        with pytest.raises(ConfigError, match=message):
            check(with_mean(numbers))
    without = replace(registered, observation=replace(registered.observation, estimates={}))
    with pytest.raises(ConfigError, match=r"'usual_ball': give observation\.estimates\.mean_ball"):
        check_policy(without)
    unknown = replace(registered.observation, estimates={"mean_bal": {}} | registered.observation.estimates)
    with pytest.raises(ConfigError, match=r"nobody registered 'mean_bal'; known: .*mean_ball"):
        check_policy(replace(registered, observation=unknown))


def test_one_that_is_not_registered_is_an_unknown_name() -> None:
    with pytest.raises(ConfigError, match="unknown name 'usual_ball'"):
        check_policy(with_mean({"gain": 0.25}))
    assert "usual_ball" not in POLICY


def test_only_what_is_observed_is_computed() -> None:
    observation: ObservationConfig = config("observation=memory").observation
    assert list(observed(observation)) == ["memory", "delay", "attitude", "joints"]
    few = replace(observation, policy=["base_position", "estimated_heading"])
    assert list(observed(few)) == ["attitude"]
    assert not observed(config("observation=paddle_pose").observation)


def test_a_checkpoint_of_43400ac_has_all_that_is_put_back() -> None:
    """Names and shapes of the actor's tensors are those of commit 43400ac, which had some more."""
    saved = json.loads((DATA / "checkpoint.json").read_text())
    env = TableTennisEnv(config("observation=memory", "predictor=filter", "engine.threads=1"), 2, "cpu", 1)
    own = env.actor.computed()
    assert {"memory.state", "delay.state", "attitude.state", "joints.state", "track.positions"} < own.keys()
    saved |= {"track.age": []}  # added by pace.config.upgrade
    assert {name: list(value.shape[1:]) for name, value in own.items()} == {name: saved[name] for name in own}
    assert own.keys() <= env.state_dict().keys()
