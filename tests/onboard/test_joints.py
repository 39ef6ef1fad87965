"""The estimated joints: made-up motions that they must follow, noise that they must take away, and the task."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are

from pace.config.base import ConfigError
from pace.config.task import JointEstimateConfig
from pace.onboard.joints import JointEstimate, steady_gain
from pace.task.observations import check_policy
from tests.helpers.envs import make_env
from tests.helpers.estimates import Running, check_observed_kept_and_begun, estimated
from tests.helpers.fakes import config

DT = 0.02
NUMBERS = JointEstimateConfig(acceleration=40.0, position_noise=0.0058, velocity_noise=0.87)


class Shaking:
    """Joints with a constant acceleration, resampled each control step as the filter has it, and their sensors."""

    def __init__(self, count: int, push: float = 1.0, noise: float = 1.0) -> None:
        self.generator = torch.Generator().manual_seed(3)
        self.push, self.noise = push, noise  # of what the filter expects
        self.position, self.velocity = torch.zeros(count, 3), torch.zeros(count, 3)
        self.sensing = SimpleNamespace(joint_position=torch.zeros(count, 3), joint_velocity=torch.zeros(count, 3))
        self.look()
        self.estimate = Running(JointEstimate(NUMBERS, DT, 3), lambda: vars(self.sensing))

    def normal(self, size: float) -> torch.Tensor:
        return size * torch.randn(self.position.shape, generator=self.generator)

    def step(self) -> None:
        push = self.normal(self.push * NUMBERS.acceleration)
        self.position += DT * self.velocity + 0.5 * DT**2 * push
        self.velocity += DT * push
        self.look()

    def look(self) -> None:
        self.sensing.joint_position.copy_(self.position + self.normal(self.noise * NUMBERS.position_noise))
        self.sensing.joint_velocity.copy_(self.velocity + self.normal(self.noise * NUMBERS.velocity_noise))


def covariance() -> np.ndarray:
    """(2, 2), before what is sensed, by another method: the Riccati equation."""
    push = np.array([[0.5 * DT**2], [DT]]) * NUMBERS.acceleration
    noise = np.diag([NUMBERS.position_noise**2, NUMBERS.velocity_noise**2])
    return solve_discrete_are(np.array([[1.0, DT], [0.0, 1.0]]).T, np.eye(2), push @ push.T, noise)


def test_the_gain_solves_the_riccati_equation() -> None:
    before, noise = covariance(), np.diag([NUMBERS.position_noise**2, NUMBERS.velocity_noise**2])
    np.testing.assert_allclose(steady_gain(NUMBERS, DT), before @ np.linalg.inv(before + noise), rtol=1e-6)


def test_noise_is_reduced_to_what_the_theory_says() -> None:
    shaking, squares = Shaking(500), []
    for step in range(150):
        shaking.step()
        shaking.estimate.update()
        if step >= 50:
            off = (shaking.estimate["position"] - shaking.position, shaking.estimate["velocity"] - shaking.velocity)
            squares.append(torch.stack([part.square().mean() for part in off]))
    error = torch.stack(squares).mean(0).sqrt()
    after = (np.eye(2) - steady_gain(NUMBERS, DT)) @ covariance()
    assert float(error[0]) == pytest.approx(after[0, 0] ** 0.5, rel=0.03)
    assert float(error[1]) == pytest.approx(after[1, 1] ** 0.5, rel=0.03)
    assert float(error[1]) < 0.6 * NUMBERS.velocity_noise


def test_a_steady_motion_is_followed_without_lag() -> None:
    shaking = Shaking(2, push=0.0, noise=0.0)
    shaking.velocity += 2.0
    shaking.look()
    shaking.estimate.restart(torch.ones(2, dtype=torch.bool))
    for _ in range(50):
        shaking.step()
        shaking.estimate.update()
        torch.testing.assert_close(shaking.estimate["position"], shaking.position, atol=1e-5, rtol=0.0)
        torch.testing.assert_close(shaking.estimate["velocity"], shaking.velocity, atol=1e-4, rtol=0.0)


def test_one_world_restarts_from_the_sensed_values() -> None:
    shaking = Shaking(2)
    for _ in range(10):
        shaking.step()
        shaking.estimate.update()
    before = shaking.estimate.state.clone()
    shaking.estimate.state[0] = math.nan  # is forgotten with all the rest
    shaking.step()
    shaking.estimate.restart(torch.tensor([True, False]))
    assert torch.equal(shaking.estimate.state[1], before[1])
    assert torch.equal(shaking.estimate["position"][0], shaking.sensing.joint_position[0])
    assert torch.equal(shaking.estimate["velocity"][0], shaking.sensing.joint_velocity[0])


def test_the_task_knows_its_joints_better() -> None:
    env = make_env(64, "native", "cpu", overrides=["observation=memory", "engine.threads=1"])
    robot, sensing = env.worlds.robot, env.sensing
    position, velocity = (estimated(env, "joints", part) for part in ("position", "velocity"))
    for _ in range(30):
        env.advance(torch.zeros(64, 21))
    moving = [(given - robot.joint_velocity).square().mean().sqrt() for given in (velocity, sensing.joint_velocity)]
    assert moving[0] < 0.6 * moving[1]
    true = robot.joint_position - env.worlds.nominal
    at = [(given - true).square().mean().sqrt() for given in (position, sensing.joint_position)]
    assert at[0] < 0.95 * at[1]
    down, ahead = (estimated(env, "attitude", part) for part in ("gravity", "heading"))
    given = env.actor.onboard.paddle(sensing.base_position, down, ahead, position + env.worlds.nominal)
    torch.testing.assert_close(env.actor.paddle_position, given[0], atol=1e-5, rtol=0.0)


def test_they_are_observed_kept_and_begin_with_the_episode() -> None:
    check_observed_kept_and_begun("joints")


def test_wrong_numbers_are_refused() -> None:
    task = config("observation=memory")
    with pytest.raises(ConfigError, match=r"'estimated_joint_position': give observation\.joint_estimate"):
        check_policy(replace(task, observation=replace(task.observation, joint_estimate=None)))
    for name in ("acceleration", "position_noise", "velocity_noise"):
        for value in ("0", "-1", "nan", "inf"):
            with pytest.raises(ConfigError, match=rf"joint_estimate\.{name} must be positive and finite"):
                config("observation=memory", f"observation.joint_estimate.{name}={value}")
