"""The T1 with seven-joint arms: its arm, that it stands, what it knows of its paddle, and that it steps."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from pace.config.training import load_train_config
from pace.onboard.kinematics import PaddleChain
from pace.sim.robot import build_model
from pace.sim.robot_spec import RobotSpec
from pace.task.env import TableTennisEnv

CONFIG = load_train_config(["robot=t1_29dof"])
SPEC = RobotSpec.of(CONFIG.robot)
JOINTS, WORLDS = 27, 4


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


def test_the_robots_own_kinematics_agree_with_mujoco(model: mujoco.MjModel) -> None:
    generator = np.random.default_rng(1)
    chain, data = PaddleChain(model, SPEC.paddle), mujoco.MjData(model)
    for _ in range(WORLDS):
        data.qpos[:] = generator.uniform(-1, 1, model.nq)
        data.qpos[3:7] = [1.0, *(0.3 * data.qpos[4:6]), data.qpos[6]]
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        mujoco.mj_kinematics(model, data)
        site = data.site("paddle")
        expected = np.concatenate([site.xpos, site.xmat[[0, 3, 6]]])
        base = data.body("Trunk").xmat.reshape(3, 3)
        sensed = (data.qpos[:3], -base[2], base[:2, 0], data.qpos[7:])
        found = torch.cat(chain(*(torch.tensor(part, dtype=torch.float32)[None] for part in sensed)), dim=1)
        np.testing.assert_allclose(found[0], expected, atol=1e-5)


def test_environment_steps() -> None:
    env = TableTennisEnv(CONFIG, WORLDS, "cpu")
    assert env.action_spec.shape == (WORLDS, JOINTS)
    rollout = env.rollout(3, break_when_any_done=False)
    assert rollout["policy"].isfinite().all()
    assert rollout["next", "reward"].isfinite().all()
