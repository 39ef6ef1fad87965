"""Forward kinematics of the paddle, from sensed signals."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

SMALLEST_LENGTH = 1e-9  # a direction shorter than this has none


class PaddleChain(nn.Module):
    """Pose of the paddle from that of the trunk and the joints between them.

    The robots are the last dimension inside: operations over N robots are then contiguous in memory, four times as fast
    as N small matrix products.

    Args: model of the robot; site at the centre of the blade (``RobotSpec.paddle``).

    Errors: ``ValueError`` if a body between trunk and paddle does not have exactly one joint.
    """

    joints: Tensor
    turns: Tensor
    offsets: Tensor
    tip: Tensor

    def __init__(self, model: mujoco.MjModel, site: str) -> None:
        super().__init__()
        path = _path(model, site)
        joints = [int(model.body_jntadr[body]) for body in path]
        if min(joints) < 1 or model.jnt_pos[joints].any():
            raise ValueError("every body between trunk and paddle must have one joint, at its origin")
        pairs = zip(path, joints, strict=True)
        turns = [_turn(model.body_quat[body], model.jnt_axis[joint]) for body, joint in pairs]
        buffers = {
            "joints": torch.tensor([joint - 1 for joint in joints]),  # joint 0 is the free one
            "turns": torch.tensor(np.stack(turns), dtype=torch.float32),  # (L, 9, 3)
            "offsets": _point_and_direction(model.body_pos[path], np.zeros(3)),  # (L, 3, 2, 1)
            "tip": _point_and_direction(model.site(site).pos, np.array([1.0, 0.0, 0.0])),  # (3, 2, 1)
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

    def forward(
        self, base_position: Tensor, gravity: Tensor, heading: Tensor, joint_position: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Centre (N, 3) m and unit normal (N, 3) of the paddle, world frame.

        Args: base_position (N, 3) m; direction of gravity (N, 3), body frame, and heading (N, 2), world frame, of any
        length; joint_position (N, J) rad.
        """
        angles = joint_position.index_select(1, self.joints).T
        rates = torch.stack((torch.ones_like(angles), angles.sin(), angles.cos()), dim=1)
        turns = torch.bmm(self.turns, rates).unflatten(1, (3, 3))  # (L, 3, 3, N)
        paddle = self.tip  # a point and a direction in the link's frame, (3, 2, N)
        for link in range(turns.shape[0] - 1, -1, -1):
            paddle = (turns[link].unsqueeze(2) * paddle).sum(1) + self.offsets[link]
        paddle = to_world(paddle, gravity, heading)
        return base_position + paddle[:, 0].T, paddle[:, 1].T


def _path(model: mujoco.MjModel, site: str) -> list[int]:
    """Bodies from the trunk (exclusive) to the paddle's."""
    body = int(model.site(site).bodyid[0])
    path: list[int] = []
    while body != int(model.jnt_bodyid[0]):
        path.insert(0, body)
        body = int(model.body_parentid[body])
    return path


def _turn(quat: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """(9, 3) such that the rotation matrix of a body is this times (1, sin, cos) of its joint's angle.

    Rodrigues: R = Q (1 + sin K + (1 - cos) K K), with K v = axis x v.
    """
    fixed = np.zeros(9)
    mujoco.mju_quat2Mat(fixed, quat)
    fixed = fixed.reshape(3, 3)
    cross = np.cross(np.eye(3), axis)
    return np.stack([fixed @ part for part in (np.eye(3) + cross @ cross, cross, -cross @ cross)], axis=-1).reshape(
        9, 3
    )


def _point_and_direction(point: np.ndarray, direction: np.ndarray) -> Tensor:
    """(..., 3, 2, 1) of points (..., 3) and one direction (3,)."""
    pair = np.stack([point, np.broadcast_to(direction, point.shape)], axis=-1)[..., None]
    return torch.tensor(pair, dtype=torch.float32)


def to_world(vectors: Tensor, gravity: Tensor, heading: Tensor) -> Tensor:
    """Vectors (3, K, N) of the body frame in the world frame: R = Rz Ry Rx, roll and pitch from gravity (N, 3), yaw
    from heading (N, 2)."""
    down, ahead = gravity.unbind(1), heading.unbind(1)
    across = (down[1].square() + down[2].square()).sqrt()
    length = (across.square() + down[0].square()).sqrt().clamp(min=SMALLEST_LENGTH)
    ground = (ahead[0].square() + ahead[1].square()).sqrt().clamp(min=SMALLEST_LENGTH)
    leaning = across.clamp(min=SMALLEST_LENGTH)
    x, y, z = vectors.unbind(0)
    y, z = _rotate(y, z, -down[2] / leaning, -down[1] / leaning)  # roll
    z, x = _rotate(z, x, across / length, down[0] / length)  # pitch
    x, y = _rotate(x, y, ahead[0] / ground, ahead[1] / ground)  # yaw
    return torch.stack((x, y, z))


def _rotate(a: Tensor, b: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor]:
    """Both coordinates after a rotation from the first axis towards the second."""
    return cos * a - sin * b, sin * a + cos * b
