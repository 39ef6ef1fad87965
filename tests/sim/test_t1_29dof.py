"""The T1 with seven-joint arms: its numbers, that it stands, and that both engines and both kinematics agree on it."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from pace.config.training import load_train_config
from pace.onboard.kinematics import PaddleChain
from pace.sim.engine.factory import make_engine
from pace.sim.kinematics import Kinematics
from pace.sim.robot import build_model, nominal_pose
from pace.sim.robot_spec import RobotSpec
from pace.sim.worlds import Worlds
from pace.task.env import TableTennisEnv

CONFIG = load_train_config(["robot=t1_29dof"])
SPEC = RobotSpec.of(CONFIG.robot)
MAKER, PADDLE = 34.6325, 0.17  # kg
JOINTS, WORLDS = 27, 4
EVERY = torch.ones(WORLDS, dtype=torch.bool)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_model(CONFIG.robot, CONFIG.engine, CONFIG.ball.table)


def at_nominal(model: mujoco.MjModel) -> mujoco.MjData:
    """Standing with the motors at the nominal pose."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.ctrl[:] = data.qpos[7:]
    mujoco.mj_forward(model, data)
    return data


def test_mass_joints_and_limits_are_the_makers(model: mujoco.MjModel) -> None:
    assert model.body_mass.sum() == pytest.approx(MAKER + PADDLE, abs=1e-4)
    assert model.body("right_hand_link").mass[0] == pytest.approx(0.30603 + PADDLE)
    assert len(SPEC.joints) == model.nu == JOINTS
    limits = {
        "Left_Hip_Pitch": (-3.002, 2.2166),
        "Left_Wrist_Yaw": (-1.8185, 1.4261),
        "Right_Elbow_Yaw": (-1.6844, 2.1402),
        "Right_Wrist_Pitch": (-2.5821, 2.5821),
        "Right_Hand_Roll": (-1.4285, 0.758),
    }
    for name, limit in limits.items():
        np.testing.assert_allclose(model.joint(name).range, limit)
    efforts = {"Right_Wrist_Pitch": 7.0, "Right_Wrist_Yaw": 18.0, "Right_Hand_Roll": 7.0, "Waist": 25.0}
    for name, effort in efforts.items():
        np.testing.assert_allclose(model.actuator(name).forcerange, (-effort, effort))


def test_its_motors_are_those_of_the_t1(model: mujoco.MjModel) -> None:
    """Joints of the same name have the same armature and friction; wrist yaw has the motor of the arm."""
    config = load_train_config(["robot=t1"])
    other = build_model(config.robot, config.engine, config.ball.table)
    for name in SPEC.joints:
        own, like = model.joint(name), name.replace("Wrist_Yaw", "Elbow_Yaw")
        if "Wrist_Pitch" in name or "Hand_Roll" in name:
            assert (own.armature[0], own.frictionloss[0]) == (0.001, 0.2)
        else:
            known = other.joint(like)
            assert (own.armature[0], own.frictionloss[0]) == (known.armature[0], known.frictionloss[0])


def test_the_arm_reaches_from_the_trunk_to_the_paddle() -> None:
    parts = "Shoulder_Pitch", "Shoulder_Roll", "Elbow_Pitch", "Elbow_Yaw", "Wrist_Pitch", "Wrist_Yaw", "Hand_Roll"
    assert SPEC.arm == SPEC.groups["right_arm"] == tuple(f"Right_{part}" for part in parts)
    contacts = RobotSpec.of(load_train_config().robot).contacts
    assert tuple(name for name in SPEC.contacts if name not in ("left_hand", "right_hand")) == contacts


def test_nominal_paddle_is_where_the_t1_holds_its_own(model: mujoco.MjModel) -> None:
    old = load_train_config().robot
    other = at_nominal(build_model(old, CONFIG.engine, CONFIG.ball.table))
    data = at_nominal(model)
    assert np.linalg.norm(data.site("paddle").xpos - other.site("paddle").xpos) < 0.05
    normal = data.site("paddle").xmat[[0, 3, 6]]
    np.testing.assert_allclose(normal, other.site("paddle").xmat[[0, 3, 6]], atol=1e-6)
    assert normal[0] > 0.8  # towards the opponent


def test_motors_hold_the_nominal_pose_for_half_a_second(model: mujoco.MjModel) -> None:
    """Away from the table, which it would lean on. Later it tips over, as the T1 does: the gains leave balance to a
    policy."""
    data = at_nominal(model)
    for foot in SPEC.feet:
        assert data.site(foot).xpos[2] == pytest.approx(0.0, abs=1e-6)
    data.qpos[0] = -4.0
    start = data.qpos[2]
    while data.time < 0.5:
        mujoco.mj_step(model, data)
    assert start - data.qpos[2] < 0.02
    assert data.body("Trunk").xmat[8] > 0.99
    assert (np.abs(data.sensordata[[2, 5]]) > 50.0).all()  # N, upwards, on each foot
    assert not data.sensordata[6:].any()  # nothing but the feet touches anything


def test_kinematics_agree_with_mujoco(model: mujoco.MjModel) -> None:
    generator = np.random.default_rng(1)
    qpos, qvel = generator.uniform(-1, 1, (WORLDS, 2, model.nq)), generator.uniform(-1, 1, (WORLDS, 2, model.nv))
    qpos[..., 4:6] *= 0.3
    qpos[..., 3] = 1.0
    qpos[..., 3:7] /= np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
    kinematics = Kinematics(model, SPEC.tips, WORLDS, 1, "cpu")
    kinematics.update(*(torch.tensor(part, dtype=torch.float32) for part in (qpos, qvel)))
    chain = PaddleChain(model, SPEC.paddle)
    data = mujoco.MjData(model)
    for world in range(WORLDS):
        data.qpos[:] = qpos[world, 1]
        mujoco.mj_kinematics(model, data)
        site = data.site("paddle")
        expected = np.concatenate([site.xpos, site.xmat[[0, 3, 6]]])
        np.testing.assert_allclose(kinematics.paddle_path[world, 1, :6], expected, atol=1e-5)
        np.testing.assert_allclose(kinematics.foot_position[world, 0], data.site("left_foot").xpos, atol=1e-5)
        base = data.body("Trunk").xmat.reshape(3, 3)
        sensed = (data.qpos[:3], -base[2], base[:2, 0], data.qpos[7:])
        found = torch.cat(chain(*(torch.tensor(part, dtype=torch.float32)[None] for part in sensed)), dim=1)
        np.testing.assert_allclose(found[0], expected, atol=1e-5)


@pytest.mark.parametrize("engine", ["native", pytest.param("mjwarp", marks=pytest.mark.slow)])
def test_worlds_step(engine: str) -> None:
    config = load_train_config(["robot=t1_29dof", f"engine={engine}"])
    worlds = Worlds(config, WORLDS, "cpu")
    targets = torch.as_tensor(nominal_pose(config.robot), dtype=torch.float32).repeat(WORLDS, 1)
    start = torch.as_tensor(worlds.model.key_qpos[0], dtype=torch.float32).repeat(WORLDS, 1)
    worlds.reset_robot(EVERY, start, torch.zeros(WORLDS, worlds.model.nv))
    for _ in range(4):
        worlds.step(targets)
    for value in (worlds.engine.qpos_path, worlds.engine.qvel_path, worlds.kinematics.paddle_path):
        assert value.isfinite().all()


@pytest.mark.slow
def test_engines_agree() -> None:
    """Tolerances of ``tests/sim/engine/test_engine.py``."""
    pair = []
    for name in ("native", "mjwarp"):
        options = dataclasses.replace(CONFIG.engine, name=name)
        model = build_model(CONFIG.robot, options, CONFIG.ball.table)
        pair.append(make_engine(model, options, WORLDS, "cpu", CONFIG.substeps))
    native, warp = pair
    start = torch.as_tensor(model.key_qpos[0], dtype=torch.float32).repeat(WORLDS, 1)
    for engine in pair:
        engine.reset(EVERY, start, torch.zeros(WORLDS, model.nv))
    generator = torch.Generator().manual_seed(5)
    for _ in range(5):
        targets = start[:, None, 7:] + 0.25 * torch.randn(WORLDS, 1, JOINTS, generator=generator)
        for engine in pair:
            engine.advance(targets.repeat(1, CONFIG.substeps, 1), torch.zeros(WORLDS, model.nv))
        torch.testing.assert_close(warp.qpos_path, native.qpos_path, atol=1e-4, rtol=0)
        torch.testing.assert_close(warp.qvel_path, native.qvel_path, atol=1e-2, rtol=0)
        torch.testing.assert_close(warp.foot_force, native.foot_force, atol=1.0, rtol=1e-2)
        torch.testing.assert_close(warp.joint_torque, native.joint_torque, atol=0.05, rtol=0)


def test_environment_steps() -> None:
    env = TableTennisEnv(CONFIG, WORLDS, "cpu")
    assert env.action_spec.shape == (WORLDS, JOINTS)
    rollout = env.rollout(3, break_when_any_done=False)
    assert rollout["policy"].isfinite().all()
    assert rollout["next", "reward"].isfinite().all()
