"""How the robot finds out the delay of its motion capture: made-up turns with a known delay, and simulated ones."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.task import DelayEstimateConfig
from pace.onboard.delay import DelayEstimate
from pace.task.observations import check_policy
from tests.helpers.envs import make_env
from tests.helpers.estimates import Running, check_observed_kept_and_begun, estimated
from tests.helpers.fakes import config

DT = 0.02
CONFIG = DelayEstimateConfig(prior=0.017, prior_worth=5.0, smoothing=0.9, fading=1.0)
NO_NOISE = [
    f"sensing.{name}=0"
    for name in ("base_angular_velocity", "base_position", "projected_gravity", "joint_position", "joint_velocity")
] + [f"sensing.{name}=0" for name in ("ball_position", "heading", "base_shift")]


class Turning:
    """Trunks that swing about the vertical, psi = 0.6 sin(4 t), leaning by 0.2 rad, and what is sensed of them late."""

    def __init__(self, delays: Tensor, start: float = 0.0) -> None:
        count = len(delays)
        self.delays, self.start, self.time = delays, start, 0.0
        lean = torch.tensor([math.sin(0.2), 0.0, -math.cos(0.2)])
        self.sensing = SimpleNamespace(
            base_angular_velocity=torch.zeros(count, 3),
            projected_gravity=lean.repeat(count, 1),
            heading=torch.zeros(count, 2),
        )
        self.look()
        self.estimate = Running(DelayEstimate(CONFIG, DT, 0), lambda: vars(self.sensing))

    def look(self) -> None:
        yaw = self.start + 0.6 * torch.sin(4.0 * (self.time - self.delays))
        rate = 2.4 * math.cos(4.0 * self.time)
        # about the vertical, in the frame of the leaning trunk; and about its own x axis, which turns no heading
        self.sensing.base_angular_velocity.copy_(-rate * self.sensing.projected_gravity)
        self.sensing.base_angular_velocity[:, 0] += math.sin(7.0 * self.time)
        self.sensing.heading.copy_(torch.stack((yaw.cos(), yaw.sin()), dim=1))

    def run(self, steps: int) -> None:
        for _ in range(steps):
            self.time += DT
            self.look()
            self.estimate.update()

    @property
    def error(self) -> Tensor:
        return self.estimate["delay"].squeeze(1) + CONFIG.prior - self.delays


@pytest.mark.parametrize("start", [0.0, math.pi])  # also where the yaw jumps from pi to minus pi
def test_turns_tell_the_delay(start: float) -> None:
    turning = Turning(torch.tensor([0.0, 0.004, 0.017, 0.03, 0.05]), start)
    assert turning.estimate["delay"].abs().max() == 0.0
    turning.run(400)
    assert turning.error.abs().max() < 1.5e-3  # of the first order in the delay


def test_the_prior_is_worth_what_it_says() -> None:
    turning = Turning(torch.tensor([0.03]))
    turning.run(30)
    squares = float(turning.estimate.state[0, 6])
    without = float(turning.estimate.state[0, 5]) / squares
    expected = (squares * without + CONFIG.prior_worth * CONFIG.prior) / (squares + CONFIG.prior_worth)
    assert 1.0 < squares < 50.0
    assert float(turning.estimate["delay"]) + CONFIG.prior == pytest.approx(expected, abs=1e-6)


def test_one_world_restarts() -> None:
    turning = Turning(torch.tensor([0.0, 0.03]))
    turning.run(100)
    before = turning.estimate.state.clone()
    turning.estimate.restart(torch.tensor([True, False]))
    assert torch.equal(turning.estimate.state[1], before[1])
    assert turning.estimate.state[0, 3:].abs().max() == 0.0
    turning.run(300)
    assert turning.error.abs().max() < 1.5e-3


def test_a_simulated_robot_finds_its_delay() -> None:
    """Robots that swing at the waist: the estimate follows the simulation's delay, which it never sees."""
    settings = ["observation=memory", "sensing=wide", *NO_NOISE, "engine.threads=1", "engine.physics_dt=0.002"]
    env = make_env(32, "native", "cpu", overrides=[*settings, "sensing.mocap_delay=[0.0,0.04]"])
    waist = env.worlds.spec.joints.index("Waist")
    delay = env.sensing.delay * DT
    for step in range(40):
        action = torch.zeros(32, 21)
        action[:, waist] = 4.0 * math.sin(2.0 * math.pi * step / 20)
        env.advance(action)
    prior = env.config.observation.delay_estimate.prior  # type: ignore[union-attr]
    estimate = estimated(env, "delay", "delay").squeeze(1) + prior
    assert torch.corrcoef(torch.stack((estimate, delay)))[0, 1] > 0.95
    assert float((estimate - delay).abs().mean()) < 0.004
    shown = env.policy_observation.view(32, 5, -1)[:, -1, env.policy_layout["sensed_delay"]]
    assert torch.equal(shown, estimated(env, "delay", "delay"))
    assert torch.equal(env.critic_observation[:, env.critic_layout["mocap_delay"]].squeeze(1), env.sensing.delay)


def test_it_is_part_of_the_state_and_of_the_episode() -> None:
    check_observed_kept_and_begun("delay")
    env = make_env(2, "native", "cpu", overrides=["observation=memory", "engine.threads=1"])
    for _ in range(5):
        env.advance(torch.zeros(2, 21))
    assert estimated(env, "delay", "delay").abs().min() > 0.0
    env.reset_worlds(torch.tensor([True, False]))
    assert estimated(env, "delay", "delay")[0] == 0.0


def test_wrong_numbers_are_refused() -> None:
    task = config("observation=memory")
    with pytest.raises(ConfigError, match=r"give observation\.delay_estimate"):
        check_policy(replace(task, observation=replace(task.observation, delay_estimate=None)))
    with pytest.raises(ConfigError, match=r"delay_estimate.smoothing must lie in"):
        config("observation=memory", "observation.delay_estimate.smoothing=nan")
    with pytest.raises(ConfigError, match=r"delay_estimate.prior must not be negative"):
        config("observation=memory", "observation.delay_estimate.prior=-0.1")
    with pytest.raises(ConfigError, match=r"delay_estimate.prior_worth must be positive"):
        config("observation=memory", "observation.delay_estimate.prior_worth=0")
