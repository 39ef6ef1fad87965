"""The model against the maker's description of T1, the table and the configuration."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from pace.config.base import ConfigError
from pace.config.training import load_train_config
from pace.sim.robot import (
    NOMINAL_KEY,
    build_model,
    joint_armature,
    joint_friction,
    joint_gains,
    motor_lines,
    nominal_pose,
)
from pace.sim.robot_spec import RobotSpec

#: joint: (lower, upper, effort of t1_paper) in rad and N m, from the maker's description; every other
#: joint mirrors its sibling.
LIMITS = {
    "Left_Shoulder_Pitch": (-3.31, 1.22, 18),
    "Left_Shoulder_Roll": (-1.74, 1.57, 18),
    "Left_Elbow_Pitch": (-2.27, 2.27, 18),
    "Left_Elbow_Yaw": (-2.44, 0.0, 18),
    "Right_Shoulder_Pitch": (-3.31, 1.22, 18),
    "Right_Shoulder_Roll": (-1.57, 1.74, 18),
    "Right_Elbow_Pitch": (-2.27, 2.27, 18),
    "Right_Elbow_Yaw": (0.0, 2.44, 18),
    "Waist": (-1.57, 1.57, 30),
    "Left_Hip_Pitch": (-1.8, 1.57, 45),
    "Left_Hip_Roll": (-0.2, 1.57, 30),
    "Left_Hip_Yaw": (-1.0, 1.0, 30),
    "Left_Knee_Pitch": (0.0, 2.34, 60),
    "Left_Ankle_Pitch": (-0.87, 0.35, 20),
    "Left_Ankle_Roll": (-0.44, 0.44, 15),
    "Right_Hip_Pitch": (-1.8, 1.57, 45),
    "Right_Hip_Roll": (-1.57, 0.2, 30),
    "Right_Hip_Yaw": (-1.0, 1.0, 30),
    "Right_Knee_Pitch": (0.0, 2.34, 60),
    "Right_Ankle_Pitch": (-0.87, 0.35, 20),
    "Right_Ankle_Roll": (-0.44, 0.44, 15),
}
#: The same of t1_29dof, from the maker's description of it.
LIMITS_29 = {
    "Left_Shoulder_Pitch": (-3.29, 1.18, 18),
    "Left_Shoulder_Roll": (-1.577, 1.7055, 18),
    "Left_Elbow_Pitch": (-2.234, 2.234, 18),
    "Left_Elbow_Yaw": (-2.1402, 1.6844, 18),
    "Left_Wrist_Pitch": (-2.5821, 2.5821, 7),
    "Left_Wrist_Yaw": (-1.8185, 1.4261, 18),
    "Left_Hand_Roll": (-0.758, 1.4285, 7),
    "Right_Shoulder_Pitch": (-3.29, 1.1868, 18),
    "Right_Shoulder_Roll": (-1.7055, 1.577, 18),
    "Right_Elbow_Pitch": (-2.234, 2.234, 18),
    "Right_Elbow_Yaw": (-1.6844, 2.1402, 18),
    "Right_Wrist_Pitch": (-2.5821, 2.5821, 7),
    "Right_Wrist_Yaw": (-1.4261, 1.8185, 18),
    "Right_Hand_Roll": (-1.4285, 0.758, 7),
    "Waist": (-1.57, 1.57, 25),
    "Left_Hip_Pitch": (-3.002, 2.2166, 45),
    "Left_Hip_Roll": (-0.2, 1.57, 25),
    "Left_Hip_Yaw": (-1.0, 1.0, 25),
    "Left_Knee_Pitch": (0.0, 2.1817, 60),
    "Left_Ankle_Pitch": (-0.87, 0.35, 24),
    "Left_Ankle_Roll": (-0.44, 0.44, 15),
    "Right_Hip_Pitch": (-3.002, 2.2166, 45),
    "Right_Hip_Roll": (-1.57, 0.2, 25),
    "Right_Hip_Yaw": (-1.0, 1.0, 25),
    "Right_Knee_Pitch": (0.0, 2.1817, 60),
    "Right_Ankle_Pitch": (-0.87, 0.35, 24),
    "Right_Ankle_Roll": (-0.44, 0.44, 15),
}
#: Of t1 and t1_29dof, by part of the joint's name: effort (N m), max_speed (rad/s), armature (kg m^2), friction (N m).
NEWEST = {
    "Shoulder": (18, 7.33, 0.0283, 0.5),
    "Elbow": (18, 7.33, 0.0283, 0.5),
    "Waist": (25, 12.57, 0.0478, 0.46),
    "Hip_Pitch": (45, 16.76, 0.0524, 0.49),
    "Hip_Roll": (25, 12.57, 0.0478, 0.88),
    "Hip_Yaw": (25, 12.57, 0.0478, 0.24),
    "Knee": (60, 12.57, 0.0636, 1.0),
    "Ankle_Pitch": (24, 18.8, 0.068, 0.72),
    "Ankle_Roll": (15, 12.4, 0.068, 0.21),
    "Wrist_Yaw": (18, 7.33, 0.0283, 0.5),
    "Wrist_Pitch": (7, 12.56, 0.001, 0.2),
    "Hand_Roll": (7, 12.56, 0.001, 0.2),
}
LINK_MASSES = {
    "Trunk": 11.7,
    "H1": 0.44391,
    "H2": 0.631019,
    "left_hand_link": 0.327214,
    "right_hand_link": 0.61801,
    "Waist": 2.581,
    "Hip_Yaw_Left": 2.166,
    "Hip_Yaw_Right": 2.17,
    "Shank_Left": 1.73,
    "Shank_Right": 1.79,
    "left_foot_link": 0.685,
}
#: The same of t1_29dof; the right hand holds a paddle of 0.17 kg.
LINK_MASSES_29 = {
    "Trunk": 11.7,
    "H1": 0.44391,
    "H2": 0.631019,
    "left_hand_link": 0.30603,
    "Waist": 2.581,
    "Hip_Yaw_Left": 2.166,
    "Hip_Yaw_Right": 2.17,
    "Shank_Left": 1.82,
    "Shank_Right": 1.82,
    "left_foot_link": 0.685,
    "right_hand_link": 0.30603 + 0.17,
}


#: These differ in their motors alone.
T1 = ["t1", "t1_paper"]


@pytest.fixture(scope="module", params=[*T1, "t1_29dof"])
def config(request):
    return load_train_config([f"robot={request.param}"])


@pytest.fixture(scope="module")
def spec(config):
    return RobotSpec.of(config.robot)


@pytest.fixture(scope="module")
def limits(config):
    return LIMITS if config.robot.name in T1 else LIMITS_29


@pytest.fixture(scope="module")
def model(config):
    return build_model(config.robot, config.engine, config.ball.table)


def test_sizes_and_masses(config, model, limits):
    assert (model.nq, model.nv, model.nu) == (7 + len(limits), 6 + len(limits), len(limits))
    total, links, masses = 31.9052, 24, LINK_MASSES
    if config.robot.name == "t1_29dof":
        total, links, masses = 34.6325 + 0.17, 30, LINK_MASSES_29
    assert np.sum(model.body_mass) == pytest.approx(total, abs=1e-4)
    assert np.count_nonzero(model.body_mass) == links  # table and ball weigh nothing here
    for link, mass in masses.items():
        assert model.body(link).mass[0] == pytest.approx(mass, rel=1e-9)


@pytest.mark.parametrize("config", T1, indirect=True)
def test_paddle_link_has_the_inertia_of_the_variant(model):
    link = model.body("right_hand_link")
    np.testing.assert_allclose(link.ipos, [-0.0002776, -0.175966, 0.000603], atol=1e-9)
    np.testing.assert_allclose(link.inertia, [0.008396694, 0.000448921, 0.008121539], atol=1e-9)
    blade = model.geom("paddle")
    np.testing.assert_allclose(blade.size[:2], [0.078, 0.0075])
    np.testing.assert_allclose(blade.pos, [0, -0.345, 0])
    axis = np.zeros(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0, 1]), blade.quat)  # a cylinder's axis is its local z
    np.testing.assert_allclose(np.abs(axis), [1, 0, 0], atol=1e-12)


def test_joints_are_in_order_with_their_limits(config, model, spec, limits):
    assert tuple(model.joint(i).name for i in range(1, model.njnt)) == spec.joints == tuple(limits)
    assert tuple(model.actuator(i).name for i in range(model.nu)) == spec.joints
    for index, (name, (lower, upper, effort)) in enumerate(limits.items()):
        if config.robot.name == "t1":
            effort = next(numbers[0] for part, numbers in NEWEST.items() if part in name)
        np.testing.assert_allclose(model.jnt_range[1 + index], [lower, upper])
        np.testing.assert_allclose(model.actuator_forcerange[index], [-effort, effort])


def test_motors_armature_and_friction_reach_each_joint(config, model, limits):
    of_joint = [next(numbers for part, numbers in NEWEST.items() if part in name) for name in limits]
    _, speed, armature, friction = np.array(of_joint).T
    if config.robot.name == "t1_paper":
        armature, friction = np.full(len(limits), 0.01), np.zeros(len(limits))
    else:
        lines = motor_lines(config.robot)
        assert lines is not None
        np.testing.assert_allclose(lines[0], speed)
    np.testing.assert_allclose(joint_armature(config.robot), armature)
    np.testing.assert_allclose(model.dof_armature[6:], armature)
    np.testing.assert_allclose(joint_friction(config.robot), friction)
    np.testing.assert_allclose(model.dof_frictionloss[6:], friction)
    assert not model.dof_frictionloss[:6].any()


def test_head_is_rigid_with_the_trunk(model):
    for body in ("H1", "H2"):
        assert model.body(body).jntnum[0] == 0
        assert model.body(body).weldid[0] == model.body("Trunk").id


def test_gains_and_solver_come_from_the_configuration(config, spec):
    changes = [{"kp": 2 * g.kp, "kd": 3 * g.kd, "effort": g.effort / 2} for g in config.robot.joint_groups]
    groups = [
        dataclasses.replace(g, armature=None, **new) for g, new in zip(config.robot.joint_groups, changes, strict=True)
    ]
    robot = dataclasses.replace(config.robot, armature=0.02, joint_groups=groups)
    engine = dataclasses.replace(config.engine, physics_dt=0.004, solver_iterations=7, cone="elliptic")
    model = build_model(robot, engine, config.ball.table)
    kp, kd, effort = joint_gains(config.robot)
    np.testing.assert_allclose(model.actuator_gainprm[:, 4], 2 * kp)
    np.testing.assert_allclose(model.actuator_gainprm[:, 6], 3 * kd)
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], effort / 2)
    plain = build_model(dataclasses.replace(robot, stall_ratio=0.0), engine, config.ball.table)
    np.testing.assert_allclose(plain.actuator_gainprm[:, 0], 2 * kp)
    np.testing.assert_allclose(-plain.actuator_biasprm[:, 1], 2 * kp)
    np.testing.assert_allclose(-plain.actuator_biasprm[:, 2], 3 * kd)
    np.testing.assert_allclose(model.dof_armature[6:], 0.02)
    assert (model.opt.timestep, model.opt.iterations) == (0.004, 7)
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert (kp[spec.joints.index("Right_Knee_Pitch")], kp[spec.joints.index("Left_Ankle_Roll")]) == (100, 30)


def test_nominal_keyframe_stands_on_both_feet(config, model):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(NOMINAL_KEY).id)
    np.testing.assert_allclose(data.qpos[7:], nominal_pose(config.robot))
    mujoco.mj_forward(model, data)
    assert data.site("left_foot").xpos[2] == pytest.approx(data.site("right_foot").xpos[2], abs=1e-9)
    feet = {model.geom(int(g)).name[:10] for c in data.contact for g in c.geom if g != model.geom("floor").id}
    assert feet == {"left_foot_", "right_foot"}
    assert 0.6 < data.qpos[2] < config.robot.base_height


def test_table_and_paddle_follow_the_table_configuration(config):
    sizes = {"length": 3.0, "height": 0.8, "thickness": 0.02, "net_height": 0.2, "paddle_radius": 0.07}
    table = dataclasses.replace(config.ball.table, **sizes)
    model = build_model(config.robot, config.engine, table, visual=True)
    slab = model.geom("table")
    assert slab.pos[2] + slab.size[2] == pytest.approx(0.8)
    np.testing.assert_allclose(slab.size, [1.5, config.ball.table.width / 2, 0.01])
    tape = model.geom("net_tape")
    assert tape.pos[2] + tape.size[2] == pytest.approx(1.0)
    assert tape.size[1] == pytest.approx(config.ball.table.width / 2 + config.ball.table.net_overhang)
    assert model.geom("paddle").size[0] == pytest.approx(0.07)


def test_visual_geoms_do_not_change_the_dynamics(config, model):
    shown = build_model(config.robot, config.engine, config.ball.table, visual=True)
    assert shown.ngeom > 2 * model.ngeom
    np.testing.assert_array_equal(shown.body_mass, model.body_mass)
    ends = []
    for m in (model, shown):
        data = mujoco.MjData(m)
        mujoco.mj_resetDataKeyframe(m, data, 0)
        data.ctrl[:] = nominal_pose(config.robot)
        mujoco.mj_step(m, data, nstep=20)
        ends.append(data.qpos.copy())
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)


def test_ball_is_a_mocap_body_that_touches_nothing(model, spec):
    assert model.nmocap == 1
    assert model.body("ball").mocapid[0] == 0
    pairs = {model.geom(int(g)).name for g in np.concatenate([model.pair_geom1, model.pair_geom2])}
    assert "ball" not in pairs
    assert not model.geom_contype.any()
    assert set(spec.contacts) | {"floor", "table"} <= pairs


def test_every_contact_body_has_its_sensor_in_order(model, spec):
    names = [model.sensor(i).name for i in range(model.nsensor)]
    touches = [f"{body}_touch" for body in spec.contacts]
    assert names == ["left_foot_force", "right_foot_force", *touches, "table_force", "free_hand_force"]


def test_a_robot_without_a_free_hand_has_no_sensor_for_it(config, spec):
    for hand, count in (("left_hand_link", 2), ("", 1)):
        robot = dataclasses.replace(config.robot, free_hand=hand)
        model = build_model(robot, config.engine, config.ball.table)
        assert model.nsensordata == 2 * 3 + len(spec.contacts) + 3 * count
    with pytest.raises(ConfigError, match=r"robot\.free_hand: the robot has no body third_hand"):
        build_model(dataclasses.replace(config.robot, free_hand="third_hand"), config.engine, config.ball.table)


def test_wrong_joint_names_are_config_errors(config):
    pose = dataclasses.replace(config.robot, nominal_pose={"Left_Tail": 0.1})
    with pytest.raises(ConfigError, match="Left_Tail"):
        nominal_pose(pose)
    groups = dataclasses.replace(config.robot, joint_groups=config.robot.joint_groups[1:])
    with pytest.raises(ConfigError, match="Left_Hip_Pitch"):
        joint_gains(groups)


@pytest.mark.parametrize("key", ["armature", "friction"])
@pytest.mark.parametrize("value", [-0.1, math.inf, math.nan])
def test_wrong_armature_and_friction_are_config_errors(config, key, value):
    with pytest.raises(ConfigError, match=rf"Hip_Pitch.*{key}"):
        dataclasses.replace(config.robot.joint_groups[0], **{key: value})
