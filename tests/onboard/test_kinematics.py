"""The paddle's pose from sensed signals: against MuJoCo, and against the kinematics of the simulation."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from pace.onboard.kinematics import PaddleChain, to_world
from pace.sim.kinematics import Kinematics
from pace.sim.robot import build_model
from tests.helpers.fakes import config
from tests.helpers.robot import SPEC

COUNT = 50


def make_model() -> mujoco.MjModel:
    task = config()
    return build_model(task.robot, task.engine, task.ball.table)


def quaternions() -> tuple[torch.Tensor, torch.Tensor]:
    """(N, 4) w, x, y, z and their matrices (N, 3, 3)."""
    quat = torch.nn.functional.normalize(torch.randn(COUNT, 4), dim=1)
    quat[:, 1:3] *= 0.4  # heading and gravity describe all but a base that lies on its nose
    quat = torch.nn.functional.normalize(quat, dim=1)
    matrix = np.zeros((COUNT, 9))
    for row, q in zip(matrix, quat.double().numpy(), strict=True):
        mujoco.mju_quat2Mat(row, q)
    return quat, torch.from_numpy(matrix).float().view(COUNT, 3, 3)


def test_paddle_and_base_as_the_simulation_has_them() -> None:
    """Both chains are written from the same model, by different methods."""
    torch.manual_seed(2)
    model = make_model()
    position, joints = torch.randn(COUNT, 3), torch.randn(COUNT, 21)
    quat, truth = quaternions()
    gravity, heading = -truth[:, 2], truth[:, :2, 0]
    found = to_world(torch.eye(3).unsqueeze(2), gravity, heading).permute(2, 0, 1)
    torch.testing.assert_close(found, truth, atol=1e-5, rtol=0.0)
    scales = 0.5 + torch.rand(COUNT, 1)  # directions of any length
    centre, normal = PaddleChain(model, SPEC.paddle)(position, scales * gravity, scales * heading, joints)
    data = mujoco.MjData(model)
    for world in range(COUNT):
        data.qpos[:] = torch.cat((position[world], quat[world], joints[world])).double().numpy()
        mujoco.mj_kinematics(model, data)
        site = data.site("paddle")
        np.testing.assert_allclose(centre[world], site.xpos, atol=1e-5)
        np.testing.assert_allclose(normal[world], site.xmat[[0, 3, 6]], atol=1e-5)


@pytest.mark.parametrize(("roll", "pitch", "yaw"), [(0.0, 0.0, 0.0), (0.3, -0.2, 0.7), (-0.1, 0.4, -2.5)])
def test_orientation_from_gravity_and_heading(roll: float, pitch: float, yaw: float) -> None:
    def axis(angle: float, index: int) -> list[float]:
        quat = [math.cos(angle / 2), 0.0, 0.0, 0.0]
        quat[index] = math.sin(angle / 2)
        return quat

    def product(a: list[float], b: list[float]) -> list[float]:
        w, x, y, z = a
        q, i, j, k = b
        return [
            w * q - x * i - y * j - z * k, w * i + x * q + y * k - z * j,
            w * j - x * k + y * q + z * i, w * k + x * j - y * i + z * q,
        ]  # fmt: skip

    expected = product(product(axis(yaw, 3), axis(pitch, 2)), axis(roll, 1))
    w, x, y, z = expected
    gravity = torch.tensor([[2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1]])
    heading = torch.tensor([[1 - 2 * (y * y + z * z), 2 * (x * y + w * z)]])
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.array(expected))
    # noise leaves neither of unit length
    found = to_world(torch.eye(3).unsqueeze(2), 1.3 * gravity, 0.8 * heading)[..., 0]
    np.testing.assert_allclose(found, matrix.reshape(3, 3), atol=1e-6)


def test_it_agrees_with_the_simulations_own_chain() -> None:
    torch.manual_seed(3)
    model = make_model()
    task_pose = torch.tensor(model.key_qpos[0, 7:], dtype=torch.float32)
    position, joints = 0.5 * torch.randn(COUNT, 3), task_pose + 0.5 * torch.randn(COUNT, 21)
    quat, truth = quaternions()
    path = torch.cat((position, quat, joints), dim=1).unsqueeze(1).repeat(1, 2, 1)
    kinematics = Kinematics(model, SPEC.tips, COUNT, 1, "cpu")
    kinematics.update(path, torch.zeros(COUNT, 2, model.nv))
    centre, normal = PaddleChain(model, SPEC.paddle)(position, -truth[:, 2], truth[:, :2, 0], joints)
    torch.testing.assert_close(centre, kinematics.paddle_path[:, -1, :3], atol=2e-6, rtol=0.0)
    torch.testing.assert_close(normal, kinematics.paddle_path[:, -1, 3:6], atol=2e-6, rtol=0.0)
