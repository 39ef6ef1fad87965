"""Delay and noise of the sensed signals, and the orientation computed from them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pace.config.sim import SensingConfig
from pace.sim.sensing import Sensing
from tests.helpers.fakes import CPU, config, fake_robot

DT = 0.02
NONE = torch.zeros(4, dtype=torch.bool)
ALL = torch.ones(4, dtype=torch.bool)


def make(sensing: SensingConfig, worlds: int = 4) -> Sensing:
    return Sensing(sensing, worlds, CPU, DT, torch.zeros(21), torch.Generator().manual_seed(0))


def clean(low: float, high: float) -> SensingConfig:
    return replace(config("sensing=clean").sensing, mocap_delay=[low, high])


def ball_at(x: float) -> Tensor:
    return torch.tensor([x, 0.0, 1.0]).repeat(4, 1)


def test_clean_sensing_is_the_truth() -> None:
    sensing, robot = make(clean(0.0, 0.0)), fake_robot(4)
    robot.joint_velocity.copy_(torch.randn(4, 21))
    sensing.reset(ALL, robot, ball_at(1.0))
    sensing.update(robot, ball_at(0.9), NONE)
    torch.testing.assert_close(sensing.ball_position, ball_at(0.9))
    for name in ("base_position", "heading", "projected_gravity", "joint_velocity", "base_angular_velocity"):
        torch.testing.assert_close(getattr(sensing, name), getattr(robot, name))


@pytest.mark.parametrize("delay", [0.004, 0.010, 0.020, 0.030, 0.055])
def test_delays_interpolate_linear_motion_exactly(delay: float) -> None:
    sensing, robot = make(clean(delay, delay)), fake_robot(4)
    sensing.reset(ALL, robot, ball_at(1.0))
    for step in range(1, 8):
        robot.base_position[:, 0] = -1.8 + 0.01 * step
        sensing.update(robot, ball_at(1.0 - 0.1 * step), NONE)
    ago = 7 - delay / DT
    torch.testing.assert_close(sensing.ball_position, ball_at(1.0 - 0.1 * ago))
    torch.testing.assert_close(sensing.base_position[:, 0], torch.full((4,), -1.8 + 0.01 * ago))


def test_delays_are_drawn_per_world_at_reset() -> None:
    sensing, robot = make(clean(0.004, 0.010), 2000), fake_robot(2000)
    everyone = torch.ones(2000, dtype=torch.bool)
    sensing.reset(everyone, robot, torch.zeros(2000, 3))
    sensing.update(robot, torch.full((2000, 3), DT), ~everyone)  # moves at 1 m/s: the lag is the delay
    lag = DT - sensing.ball_position[:, 0]
    assert 0.004 - 1e-6 <= float(lag.min()) < 0.0041
    assert 0.0099 < float(lag.max()) <= 0.010 + 1e-6
    assert float(lag.mean()) == pytest.approx(0.007, abs=1e-4)


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.010, 0.020, 0.030, 0.040])
def test_a_launched_ball_is_sensed_once_the_delay_has_passed_and_never_between_two_balls(delay: float) -> None:
    sensing, robot = make(clean(delay, delay)), fake_robot(4)
    sensing.reset(ALL, robot, ball_at(-2.0))
    robot.base_position[:, 0] += 0.1
    launched = torch.tensor([True, False, True, False])
    for step in range(5):
        sensing.update(robot, ball_at(1.35 - 0.1 * step), launched if step == 0 else NONE)
        seen = sensing.ball_position[:, 0]
        flown = step - delay / DT  # control steps since the launch, as sensed
        expected = 1.35 - 0.1 * flown if flown >= 0.0 else -2.0
        torch.testing.assert_close(seen[launched], torch.full((2,), expected))
        if step == 0 and delay == 0.010:  # a ball that flew there is sensed on its way, and so is the base
            torch.testing.assert_close(seen[~launched], torch.full((2,), -0.325))
            torch.testing.assert_close(sensing.base_position[:, 0], torch.full((4,), -1.75))


def test_noise_is_uniform_with_the_configured_amplitude() -> None:
    sensing, robot = make(config("sensing=paper").sensing, 4000), fake_robot(4000)
    everyone = torch.ones(4000, dtype=torch.bool)
    sensing.reset(everyone, robot, torch.zeros(4000, 3))
    amplitudes = {
        "base_angular_velocity": 0.2, "base_position": 0.007, "projected_gravity": 0.05, "joint_position": 0.01,
        "joint_velocity": 1.5, "ball_position": 0.007, "heading": 0.05,
    }  # fmt: skip
    truth = vars(robot) | {"ball_position": torch.zeros(4000, 3)}
    for name, amplitude in amplitudes.items():
        error = getattr(sensing, name) - truth[name]
        assert float(error.abs().max()) <= amplitude * 1.0001, name
        assert float(error.std()) == pytest.approx(amplitude / math.sqrt(3), rel=0.03), name
        assert float(error.mean()) == pytest.approx(0.0, abs=0.03 * amplitude), name
    assert float(sensing.base_shift_noise.abs().max()) <= 0.007


def test_the_scale_of_the_noise_is_drawn_per_world_and_kept() -> None:
    worlds, steps = 500, 60
    sensing, robot = make(replace(config("sensing=paper").sensing, noise_scale=[0.5, 2.0]), worlds), fake_robot(worlds)
    nobody = torch.zeros(worlds, dtype=torch.bool)
    sensing.reset(~nobody, robot, torch.zeros(worlds, 3))
    squares = torch.zeros(worlds)
    for _ in range(steps):
        sensing.update(robot, torch.zeros(worlds, 3), nobody)
        squares += (sensing.joint_position - robot.joint_position).square().mean(1)
    scale = (3.0 * squares / steps).sqrt() / 0.01  # of uniform noise of +-0.01 rad
    assert float(scale.min()) == pytest.approx(0.5, abs=0.04)
    assert float(scale.max()) == pytest.approx(2.0, abs=0.12)
    assert float(scale.mean()) == pytest.approx(1.25, abs=0.06)


def test_reset_changes_only_masked_worlds() -> None:
    sensing, robot = make(config("sensing=paper").sensing), fake_robot(4)
    sensing.reset(ALL, robot, ball_at(1.0))
    before = sensing._sensed.clone()
    mask = torch.tensor([False, True, False, False])
    sensing.reset(mask, robot, ball_at(1.3))
    assert torch.equal(sensing._sensed[~mask], before[~mask])
    assert not torch.equal(sensing._sensed[mask], before[mask])
