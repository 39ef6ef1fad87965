"""The robot at the start of an episode: no part of it begins inside another."""

from __future__ import annotations

import dataclasses
import math

import mujoco
import pytest
import torch

from pace.config.base import ConfigError
from pace.config.sim import RobotConfig
from pace.config.training import TrainConfig, load_train_config
from pace.sim.robot import build_model, nominal_pose
from pace.sim.robot_spec import RobotSpec
from pace.task.resets import PoseSampler

COUNT = 2000
DEEPEST = 0.001  # m


def starts(config: TrainConfig, model: mujoco.MjModel) -> torch.Tensor:
    """COUNT states (COUNT, 7 + J) of the training's reset."""
    limits = torch.as_tensor(model.jnt_range[1:], dtype=torch.float32)
    nominal = torch.as_tensor(nominal_pose(config.robot), dtype=torch.float32)
    ends = limits[:, 0].contiguous(), limits[:, 1].contiguous()
    sampler = PoseSampler(config.reset, config.robot, COUNT, nominal, ends, torch.Generator().manual_seed(3))
    return sampler.sample(torch.ones(COUNT, dtype=torch.bool))[0]


def own_pairs(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Pairs of geoms that can touch and both belong to the robot."""
    pairs = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    return [pair for pair in pairs if all(model.geom_bodyid[geom] > 0 for geom in pair)]


@pytest.mark.parametrize("robot", ["t1", "t1_29dof"])
def test_no_part_begins_inside_another(robot: str) -> None:
    config = load_train_config([f"robot={robot}"])
    model = build_model(config.robot, config.engine, config.ball.table)
    data, gap = mujoco.MjData(model), math.inf
    pairs = own_pairs(model)
    assert len(pairs) == 6 + len(config.robot.self_collision)  # the paddle's, and these
    for state in starts(config, model).numpy():
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        gap = min(gap, *(mujoco.mj_geomDistance(model, data, *pair, 0.1, None) for pair in pairs))
    assert gap > -DEEPEST


def test_limits_narrow_the_range_of_their_joint_alone() -> None:
    config = load_train_config(["robot=t1"])
    model = build_model(config.robot, config.engine, config.ball.table)
    without = dataclasses.replace(config, robot=dataclasses.replace(config.robot, reset_limits={}))
    narrow, wide = starts(config, model)[:, 7:], starts(without, model)[:, 7:]
    roll = RobotSpec.of(config.robot).joints.index("Left_Shoulder_Roll")
    others = torch.arange(21) != roll
    assert torch.equal(narrow[:, others], wide[:, others])
    low, high = 1.45, 0.5 * 1.35
    assert (narrow[:, roll].min(), narrow[:, roll].max()) == pytest.approx((-low, -high), abs=2e-3)
    assert (narrow[:, roll] < -0.5 * (low + high)).float().mean() == pytest.approx(0.5, abs=0.03)  # still uniform


@pytest.mark.parametrize(
    ("limits", "message"), [({"Tail": [0.0, 1.0]}, "no joint Tail"), ({"Waist": [1.0, 0.0]}, "Waist")]
)
def test_wrong_limits_are_config_errors(limits: dict[str, list[float]], message: str) -> None:
    def build(robot: RobotConfig) -> None:
        RobotSpec.of(dataclasses.replace(robot, reset_limits=limits))

    with pytest.raises(ConfigError, match=message):
        build(load_train_config(["robot=t1"]).robot)
