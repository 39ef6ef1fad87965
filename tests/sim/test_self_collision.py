"""Parts of the robot that touch each other: the pairs, the contacts on both engines, and what counts as a contact."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from pace.config.base import ConfigError
from pace.config.training import load_train_config
from pace.sim.engine.factory import make_engine
from pace.sim.robot import build_model
from pace.sim.robot_spec import RobotSpec

#: Robot: pairs of its MJCF, and those of robot.self_collision.
PAIRS = {"t1": (35, 10), "t1_paper": (35, 0), "t1_29dof": (39, 18)}
#: Case: pair, a pose (rad) in which it is apart, the joint whose target (rad) lies behind the other part's surface, and
#: how deep (m) it then is at least without the pair; None for pairs of the MJCF. The T1's upper arm meets the trunk at
#: the end of the joint's range.
Case = tuple[tuple[str, str], dict[str, float], tuple[str, float], float | None]
T1: dict[str, Case] = {
    "right forearm": (
        ("right_forearm", "trunk"),
        {
            "Right_Shoulder_Pitch": -1.18,
            "Right_Shoulder_Roll": 1.63,
            "Right_Elbow_Pitch": 1.67,
            "Right_Elbow_Yaw": 1.66,
        },
        ("Right_Shoulder_Pitch", 0.0),
        0.04,
    ),
    "left forearm": (("left_forearm", "left_thigh"), {}, ("Left_Shoulder_Roll", -1.74), 0.04),
    "upper arm": (("left_upper_arm", "trunk"), {"Left_Shoulder_Pitch": -0.45}, ("Left_Shoulder_Roll", -2.2), 0.002),
    "paddle, trunk": (
        ("paddle", "trunk"),
        {"Right_Elbow_Yaw": 2.4, "Right_Shoulder_Roll": 0.4},
        ("Right_Elbow_Pitch", 1.4),
        None,
    ),
    "paddle, head": (
        ("paddle", "head"),
        {"Right_Elbow_Pitch": -1.6, "Right_Elbow_Yaw": 2.1},
        ("Right_Shoulder_Roll", -1.0),
        None,
    ),
}
T1_29DOF: dict[str, Case] = {
    "right forearm": (
        ("right_forearm", "trunk"),
        {"Right_Elbow_Yaw": 1.5, "Right_Shoulder_Roll": 1.4},
        ("Right_Elbow_Pitch", 1.1),
        0.04,
    ),
    "left hand": (("left_hand", "left_thigh"), {"Left_Elbow_Pitch": 1.6}, ("Left_Shoulder_Pitch", 0.0), 0.04),
    "upper arm": (
        ("right_upper_arm", "right_thigh"),
        {"Right_Elbow_Pitch": -1.6, "Right_Hip_Pitch": -2.98},
        ("Right_Shoulder_Roll", 1.58),
        0.015,
    ),
    "paddle, trunk": (
        ("paddle", "trunk"),
        {"Right_Elbow_Yaw": 2.1, "Right_Shoulder_Roll": -1.0, "Right_Shoulder_Pitch": -2.4},
        ("Right_Elbow_Pitch", -1.65),
        None,
    ),
    "paddle, head": (
        ("paddle", "head"),
        {"Right_Elbow_Yaw": 2.1, "Right_Shoulder_Roll": -0.8},
        ("Right_Elbow_Pitch", -1.8),
        None,
    ),
}
#: Robot, whether its arms' pairs are listed, case.
DRIVEN = [
    *(("t1", True, case) for case in T1),
    *(("t1_paper", False, case) for case in T1 if T1[case][3] is not None),
    *(("t1_29dof", True, case) for case in T1_29DOF),
    *(
        pytest.param("t1_29dof", False, case, marks=pytest.mark.long)
        for case in T1_29DOF
        if T1_29DOF[case][3] is not None
    ),
]


@pytest.fixture(scope="module", params=sorted(PAIRS))
def config(request):
    return load_train_config([f"robot={request.param}"])


def model_of(config, engine):
    return build_model(config.robot, engine, config.ball.table)


def test_listed_pairs_touch_with_the_scenes_friction_and_not_at_the_nominal_pose(config):
    model = model_of(config, config.engine)
    pairs = {frozenset(pair) for pair in config.robot.self_collision}
    in_mjcf, listed = PAIRS[config.robot.name]
    assert (len(pairs), model.npair) == (listed, in_mjcf + listed)
    ids = zip(model.pair_geom1, model.pair_geom2, strict=True)
    assert {frozenset(model.geom(int(g)).name for g in pair) for pair in ids} >= pairs
    np.testing.assert_array_equal(model.pair_friction, np.tile(model.pair_friction[0], (model.npair, 1)))
    np.testing.assert_array_equal(model.pair_dim, 3)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    for one, other in config.robot.self_collision:
        assert mujoco.mj_geomDistance(model, data, model.geom(one).id, model.geom(other).id, 1.0, None) > 0.02


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([["right_forearm", "tail"]], r"robot\.self_collision.*tail"),
        ([["paddle", "trunk"]], r"robot\.self_collision.*paddle and trunk"),
        ([["trunk", "left_forearm"], ["left_forearm", "trunk"]], r"robot\.self_collision.*left_forearm and trunk"),
        ([["right_forearm"]], r"robot\.self_collision.*right_forearm"),
        ([["right_forearm", "trunk", "head"]], r"robot\.self_collision.*right_forearm"),
        ([["trunk", "trunk"]], r"robot\.self_collision.*trunk"),
    ],
)
def test_wrong_pairs_are_config_errors(config, pairs, message):
    with pytest.raises(ConfigError, match=message):
        model_of(
            dataclasses.replace(config, robot=dataclasses.replace(config.robot, self_collision=pairs)), config.engine
        )


@pytest.mark.parametrize("engine", ["native", "mjwarp"])
@pytest.mark.parametrize(("robot", "listed", "case"), DRIVEN)
def test_a_part_driven_into_another_is_stopped_if_the_pair_is_listed(robot, listed, case, engine):
    """In free fall. What touches the robot itself is no contact of ``body_contact``."""
    pair, pose, (joint, target), depth = (T1_29DOF if robot == "t1_29dof" else T1)[case]
    config = load_train_config([f"robot={robot}", f"engine={engine}", "engine.threads=1"])
    if not listed:
        config = dataclasses.replace(config, robot=dataclasses.replace(config.robot, self_collision=[]))
    model, joints = model_of(config, config.engine), RobotSpec.of(config.robot).joints
    qpos = torch.as_tensor(model.key_qpos, dtype=torch.float32)
    qpos[:, 2] += 1.0
    for name, angle in pose.items():
        qpos[:, 7 + joints.index(name)] = angle
    targets = qpos[:, None, 7:].clone()
    targets[..., joints.index(joint)] = target
    sim = make_engine(model, config.engine, 1, "cpu", 1)
    sim.reset(torch.ones(1, dtype=torch.bool), qpos, torch.zeros(1, model.nv))
    data, gaps, touched = mujoco.MjData(model), [], torch.zeros(1)
    ids = [model.geom(name).id for name in pair]
    for _ in range(40):  # 0.4 s
        sim.advance(targets, torch.zeros(1, model.nv))
        data.qpos[:] = sim.qpos_path[0, -1].numpy()
        mujoco.mj_kinematics(model, data)
        gaps.append(mujoco.mj_geomDistance(model, data, *ids, 1.0, None))
        touched += sim.body_contact.sum()
    assert gaps[0] > 0.015
    assert touched == 0
    if listed:
        assert min(gaps) > -0.012  # it comes by 12 mm a physics step
        assert -0.001 < gaps[-1] < 0.0
    else:
        assert depth is not None
        assert gaps[-1] < -depth


@pytest.mark.parametrize("engine", ["native", "mjwarp"])
def test_contacts_with_floor_and_table_count_and_no_others(engine):
    """The paddle lies in the table, or the trunk on the floor, with the left forearm pressed against the thigh."""
    config = load_train_config(["robot=t1", f"engine={engine}", "engine.threads=1"])
    model, spec = model_of(config, config.engine), RobotSpec.of(config.robot)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[7 + spec.joints.index("Left_Shoulder_Roll")] = -1.55
    mujoco.mj_forward(model, data)
    qpos = torch.as_tensor(data.qpos, dtype=torch.float32).repeat(2, 1)
    qpos[0, :3] += torch.tensor([-1.3, 0.0, 0.76]) - torch.as_tensor(data.site("paddle").xpos, dtype=torch.float32)
    qpos[1, 2], qpos[1, 3:7] = 0.0, torch.tensor([0.7071068, 0.0, -0.7071068, 0.0])  # on its back
    sim = make_engine(model, config.engine, 2, "cpu", 1)
    sim.reset(torch.ones(2, dtype=torch.bool), qpos, torch.zeros(2, model.nv))
    sim.advance(qpos[:, None, 7:], torch.zeros(2, model.nv))
    for state, row, part in zip(qpos, sim.body_contact, ("paddle", "trunk"), strict=True):
        data.qpos[:] = state.numpy()
        mujoco.mj_forward(model, data)
        bodies = model.geom_bodyid[data.contact.geom]
        own = {model.geom(geom).name for geom in data.contact.geom[(bodies > 0).all(1)].ravel()}
        others = {model.geom(geom).name for geom in data.contact.geom[(bodies == 0).any(1)].ravel()}
        assert own >= {"left_forearm", "left_thigh"}
        assert part in others
        assert {name for name, value in zip(spec.contacts, row, strict=True) if value} == others & set(spec.contacts)
