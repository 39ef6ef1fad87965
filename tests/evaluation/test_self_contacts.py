"""Parts of the robot inside of one another: against MuJoCo's distance, its contacts, and two spheres."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pace.evaluation.self_contacts import depths, pairs_of
from pace.sim.robot import build_model
from pace.sim.robot_spec import RobotSpec
from tests.helpers.saved import make_config

CONFIG = make_config()
MODEL = build_model(CONFIG.robot, CONFIG.engine, CONFIG.ball.table)
SPEC = RobotSpec.of(CONFIG.robot)
NOMINAL = MODEL.key_qpos[0, 7:].copy()


def posed(**angles: float) -> np.ndarray:
    """The nominal pose with some joints at other angles, rad."""
    pose = NOMINAL.copy()
    for name, angle in angles.items():
        pose[SPEC.joints.index(name)] = angle
    return pose


def placed(pose: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(MODEL)
    data.qpos[:] = MODEL.key_qpos[0]
    data.qpos[7:] = pose
    mujoco.mj_kinematics(MODEL, data)
    return data


def test_the_nominal_pose_has_none_and_neighbours_are_no_pair() -> None:
    assert depths(MODEL, SPEC, NOMINAL[None]) == {}
    names = set(pairs_of(MODEL, SPEC).values())
    assert {
        "left_forearm - trunk",
        "left_forearm - left_thigh",
        "paddle - trunk",
        "left_foot_link - right_foot_link",
    } <= names
    joined = ("left_forearm - left_upper_arm", "paddle - right_forearm", "left_shank - left_thigh", "head - trunk")
    assert not names & set(joined)
    assert not any("table" in name or "floor" in name for name in names)


def test_the_depth_of_a_posed_arm_is_mujocos_distance() -> None:
    into_trunk = posed(Left_Shoulder_Roll=-1.5, Left_Elbow_Yaw=-2.4, Left_Elbow_Pitch=1.6, Left_Shoulder_Pitch=0.9)
    into_thigh = posed(Left_Shoulder_Roll=-1.6, Left_Elbow_Yaw=0.0, Left_Hip_Pitch=-1.5, Left_Shoulder_Pitch=-0.3)
    poses = np.stack((into_trunk, NOMINAL, into_thigh))
    found = depths(MODEL, SPEC, poses)
    assert found
    for name, deep in found.items():
        one, other = name.split(" - ")
        for pose, depth in zip(poses, deep, strict=True):
            data = placed(pose)
            distance = mujoco.mj_geomDistance(MODEL, data, MODEL.geom(one).id, MODEL.geom(other).id, 1.0, None)
            assert depth == pytest.approx(max(0.0, -distance), abs=1e-9)
    trunk, thigh = found["left_forearm - trunk"], found["left_forearm - left_thigh"]
    assert (trunk > 0.03).tolist() == [True, False, False]
    assert (thigh > 0.04).tolist() == [False, False, True]


def test_two_feet_are_spheres() -> None:
    pose = posed(Left_Hip_Roll=-0.15, Right_Hip_Roll=0.15)
    data = placed(pose)
    feet = [
        [g for g in range(MODEL.ngeom) if MODEL.geom(g).name.startswith(f"{side}_foot")] for side in ("left", "right")
    ]
    gaps = [
        np.linalg.norm(data.geom_xpos[one] - data.geom_xpos[other])
        - MODEL.geom_size[one, 0]
        - MODEL.geom_size[other, 0]
        for one in feet[0]
        for other in feet[1]
    ]
    found = depths(MODEL, SPEC, pose[None])["left_foot_link - right_foot_link"]
    assert found[0] == pytest.approx(-min(gaps), abs=1e-9)


def test_a_listed_pair_is_as_deep_as_its_contact() -> None:
    """Random poses, and the pairs of paddle and body that the engine knows."""
    generator = np.random.default_rng(4)
    low, high = MODEL.jnt_range[1:].T
    poses = generator.uniform(low, high, (2000, len(low)))
    found = depths(MODEL, SPEC, poses)
    thigh, paddle = MODEL.geom("right_thigh").id, MODEL.geom("paddle").id
    compared = 0
    for pose, deep in zip(poses, found["paddle - right_thigh"], strict=True):
        data = placed(pose)
        mujoco.mj_collision(MODEL, data)
        hits = [c.dist for c in data.contact if {c.geom1, c.geom2} == {thigh, paddle}]
        assert (len(hits) > 0) == (deep > 0.0)
        if hits:
            compared += 1
            assert deep == pytest.approx(-min(hits), abs=2e-3)
    assert compared > 0
