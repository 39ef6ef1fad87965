"""Kinematics against MuJoCo's own, on random states."""

import mujoco
import numpy as np
import pytest
import torch

from pace.config.training import load_train_config
from pace.sim.kinematics import Kinematics
from pace.sim.robot import build_model
from tests.helpers.robot import SPEC

WORLDS, SUBSTEPS = 6, 3
#: float32 against float64 at lengths of about 3 m and speeds of about 10 m/s
TOLERANCE = 1e-5


@pytest.fixture(scope="module", params=["t1", "t1_29dof"])  # t1_paper has the kinematics of t1
def model(request):
    config = load_train_config([f"robot={request.param}"])
    return build_model(config.robot, config.engine, config.ball.table)


@pytest.fixture(scope="module")
def path(model):
    generator = np.random.default_rng(3)
    qpos = generator.uniform(-1.0, 1.0, (WORLDS, SUBSTEPS + 1, model.nq))
    qpos[..., 3:7] /= np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
    return qpos, generator.uniform(-3.0, 3.0, (WORLDS, SUBSTEPS + 1, model.nv))


@pytest.fixture(scope="module")
def kinematics(model, path):
    kinematics = Kinematics(model, SPEC.tips, WORLDS, SUBSTEPS, "cpu")
    kinematics.update(*(torch.tensor(p, dtype=torch.float32) for p in path))
    return kinematics


def mujoco_at(model, path, world, instant):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = path[0][world, instant], path[1][world, instant]
    mujoco.mj_forward(model, data)
    return data


def site_velocity(model, data, name):
    """Linear and angular velocity of a site, world axes."""
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, model.site(name).id, velocity, 0)
    return velocity[3:], velocity[:3]


def test_paddle_path_is_mujocos_at_every_instant(model, path, kinematics):
    for world in range(WORLDS):
        for instant in range(SUBSTEPS + 1):
            data = mujoco_at(model, path, world, instant)
            normal = data.body("right_hand_link").xmat.reshape(3, 3)[:, 0]
            linear, angular = site_velocity(model, data, "paddle")
            expected = np.concatenate([data.site("paddle").xpos, normal, linear, angular])
            np.testing.assert_allclose(kinematics.paddle_path[world, instant], expected, atol=TOLERANCE)


def test_feet_and_head_are_mujocos_at_the_end(model, path, kinematics):
    for world in range(WORLDS):
        data = mujoco_at(model, path, world, SUBSTEPS)
        np.testing.assert_allclose(kinematics.head_position[world], data.geom("head").xpos, atol=TOLERANCE)
        for foot, name in enumerate(("left_foot", "right_foot")):
            up = data.body(f"{name}_link").xmat.reshape(3, 3)[:, 2]
            linear, _ = site_velocity(model, data, name)
            np.testing.assert_allclose(kinematics.foot_position[world, foot], data.site(name).xpos, atol=TOLERANCE)
            np.testing.assert_allclose(kinematics.foot_up[world, foot], up, atol=TOLERANCE)
            np.testing.assert_allclose(kinematics.foot_velocity[world, foot], linear, atol=TOLERANCE)


def test_sole_centre_lies_between_its_corners(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    corners = [data.geom(f"left_foot_{end}_{side}").xpos for end in ("toe", "heel") for side in ("left", "right")]
    below = np.mean(corners, axis=0) - [0, 0, 0.01]  # a corner is a sphere of 1 cm
    np.testing.assert_allclose(data.site("left_foot").xpos, below, atol=1e-9)


def test_generalized_force_is_the_jacobian_transpose(model, path, kinematics):
    generator = torch.Generator().manual_seed(1)
    force = torch.randn(WORLDS, 3, generator=generator) * 20
    force[0] = 0.0
    point = kinematics.paddle_path[:, -1, :3] + 0.05 * torch.randn(WORLDS, 3, generator=generator)
    out = torch.full((WORLDS, model.nv), torch.nan)
    kinematics.paddle_generalized_force(force, point, out)
    for world in range(WORLDS):
        data = mujoco_at(model, path, world, SUBSTEPS)
        jacobian = np.zeros((3, model.nv))
        body = model.body("right_hand_link").id
        mujoco.mj_jac(model, data, jacobian, None, point[world].numpy().astype(float), body)
        np.testing.assert_allclose(out[world], jacobian.T @ force[world].numpy(), atol=2e-4)  # up to 60 N m


def test_outputs_stay_the_same_tensors(model, path):
    kinematics = Kinematics(model, SPEC.tips, WORLDS, SUBSTEPS, "cpu")
    before = [kinematics.paddle_path.data_ptr(), kinematics.foot_up.data_ptr()]
    tensors = [torch.tensor(p, dtype=torch.float32) for p in path]
    kinematics.update(*tensors)
    first = kinematics.paddle_path.clone()
    tensors[0][:, :, 0] += 1.0
    kinematics.update(*tensors)
    torch.testing.assert_close(kinematics.paddle_path[..., 0], first[..., 0] + 1.0)
    assert before == [kinematics.paddle_path.data_ptr(), kinematics.foot_up.data_ptr()]


def test_masked_worlds_are_updated_alone(model, path):
    kinematics = Kinematics(model, SPEC.tips, WORLDS, SUBSTEPS, "cpu")
    positions, velocities = (torch.tensor(p, dtype=torch.float32) for p in path)
    kinematics.update(positions, velocities)
    outputs = (kinematics.paddle_path, kinematics.foot_position, kinematics.head_position)
    before = [output.clone() for output in outputs]
    positions[:, :, 0] += 1.0
    mask = torch.tensor([False, True] * (WORLDS // 2))
    kinematics.update(positions, velocities, mask)
    for old, new in zip(
        before, (kinematics.paddle_path, kinematics.foot_position, kinematics.head_position), strict=True
    ):
        moved = (new - old)[..., 0].reshape(WORLDS, -1).mean(1)
        torch.testing.assert_close(moved, mask.float())


def test_wrong_shapes_and_order_are_clear_errors(model):
    kinematics = Kinematics(model, SPEC.tips, WORLDS, SUBSTEPS, "cpu")
    with pytest.raises(RuntimeError, match="call update"):
        kinematics.paddle_generalized_force(
            torch.zeros(WORLDS, 3), torch.zeros(WORLDS, 3), torch.zeros(WORLDS, model.nv)
        )
    with pytest.raises(ValueError, match=rf"qpos_path must have shape \(6, 4, {model.nq}\)"):
        kinematics.update(torch.zeros(WORLDS, 2, model.nq), torch.zeros(WORLDS, 2, model.nv))
