"""The estimated orientation: made-up turns that it must follow exactly, noise that it must take away, and the task."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.task import AttitudeEstimateConfig
from pace.onboard.attitude import AttitudeEstimate
from pace.onboard.kinematics import to_world
from pace.task.observations import check_policy
from tests.helpers.envs import make_env
from tests.helpers.estimates import Running, check_observed_kept_and_begun
from tests.helpers.fakes import config

DT, GAIN = 0.02, 0.1


class Tumbling:
    """Trunks whose quaternion is integrated by MuJoCo from an angular velocity in the body frame, and their sensors."""

    def __init__(self, count: int, noise: float = 0.0) -> None:
        self.noise, self.time = noise, 0.0
        self.generator = torch.Generator().manual_seed(2)
        self.quat = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        self.sensing = SimpleNamespace(
            base_angular_velocity=torch.zeros(count, 3),
            projected_gravity=torch.zeros(count, 3),
            heading=torch.zeros(count, 2),
        )
        self.look()
        self.estimate = Running(AttitudeEstimate(AttitudeEstimateConfig(GAIN), DT, 0), lambda: vars(self.sensing))

    def rate(self, time: float) -> np.ndarray:
        return np.array([0.5 * math.sin(5.0 * time), 0.4 * math.cos(4.0 * time), 3.0 * math.sin(3.0 * time)])

    def step(self) -> None:
        fine = 20
        for part in range(fine):
            rate = self.rate(self.time + (part + 0.5) * DT / fine)
            for quat in self.quat:
                mujoco.mju_quatIntegrate(quat, rate, DT / fine)
        self.time += DT
        self.look()

    def look(self) -> None:
        sensing, count = self.sensing, len(self.quat)
        sensing.base_angular_velocity.copy_(torch.from_numpy(self.rate(self.time)).expand(count, 3))
        sensing.projected_gravity.copy_(-self.matrix[:, 2])
        sensing.heading.copy_(torch.nn.functional.normalize(self.matrix[:, :2, 0], dim=1))
        for signal, size in ((sensing.projected_gravity, 1.0), (sensing.heading, 1.0)):
            signal += self.noise * size * (2.0 * torch.rand(signal.shape, generator=self.generator) - 1.0)

    @property
    def matrix(self) -> Tensor:
        matrix = np.zeros((len(self.quat), 9))
        for row, quat in zip(matrix, self.quat, strict=True):
            mujoco.mju_quat2Mat(row, quat)
        return torch.from_numpy(matrix).float().view(-1, 3, 3)

    @property
    def errors(self) -> tuple[Tensor, Tensor]:
        heading = torch.nn.functional.normalize(self.matrix[:, :2, 0], dim=1)
        return self.estimate["gravity"] + self.matrix[:, 2], self.estimate["heading"] - heading


def test_turns_are_followed_without_noise() -> None:
    tumbling = Tumbling(2)
    for _ in range(200):
        tumbling.step()
        tumbling.estimate.update()
        gravity, heading = tumbling.errors
        assert gravity.abs().max() < 6e-3  # of the second order in what is turned in a step
        assert heading.abs().max() < 6e-3
    axes = torch.eye(3, dtype=torch.float64).unsqueeze(2)
    pose = (tumbling.estimate[part].double() for part in ("gravity", "heading"))
    turned = to_world(axes, *pose).permute(2, 0, 1)  # rotation matrices
    cosine = 0.5 * ((turned * tumbling.matrix).sum((1, 2)) - 1.0)
    assert cosine.clamp(max=1.0).acos().max() < 7e-3


def test_noise_is_reduced_as_a_filter_of_this_gain_does() -> None:
    tumbling = Tumbling(400, noise=0.05)
    squares = []
    for step in range(120):
        tumbling.step()
        tumbling.estimate.update()
        if step >= 40:
            squares.append(torch.cat(tumbling.errors, dim=1).square().mean(0))
    error = torch.stack(squares).mean(0).sqrt()
    expected = 0.05 / math.sqrt(3.0) * math.sqrt(GAIN / (2.0 - GAIN))  # of white noise: 0.0066
    # a direction can err in two ways, a heading in one
    assert float(error[:3].square().sum().div(2.0).sqrt()) == pytest.approx(expected, rel=0.1)
    assert float(error[3:].square().sum().sqrt()) == pytest.approx(expected, rel=0.1)


def test_one_world_restarts_from_the_sensed_values() -> None:
    tumbling = Tumbling(2, noise=0.05)
    for _ in range(10):
        tumbling.step()
        tumbling.estimate.update()
    before = tumbling.estimate.state.clone()
    tumbling.estimate.restart(torch.tensor([True, False]))
    assert torch.equal(tumbling.estimate.state[1], before[1])
    sensed = torch.nn.functional.normalize(tumbling.sensing.projected_gravity[0], dim=0)
    assert torch.allclose(tumbling.estimate["gravity"][0], sensed, atol=1e-6)


def test_the_task_knows_its_orientation_and_paddle_better() -> None:
    error = {}
    for name, observation in (("estimated", "memory"), ("sensed", "paddle_pose")):
        env = make_env(64, "native", "cpu", overrides=[f"observation={observation}", "engine.threads=1"])
        for _ in range(30):
            env.advance(torch.zeros(64, 21))
        error[name] = float((env.actor.paddle_normal - env.worlds.robot.paddle_normal).square().mean().sqrt())
    assert error["estimated"] < 0.5 * error["sensed"]


def test_it_is_observed_kept_and_begins_with_the_episode() -> None:
    check_observed_kept_and_begun("attitude")


def test_wrong_numbers_are_refused() -> None:
    task = config("observation=memory")
    with pytest.raises(ConfigError, match=r"give observation\.attitude_estimate"):
        check_policy(replace(task, observation=replace(task.observation, attitude_estimate=None)))
    for gain in ("0", "1.5", "nan"):
        with pytest.raises(ConfigError, match=r"attitude_estimate\.gain must lie in"):
            config("observation=memory", f"observation.attitude_estimate.gain={gain}")
