"""Balls that are thrown at the moving paddle."""

from __future__ import annotations

import torch
from torch import Tensor

from pace.sim.worlds import Worlds

THROW_TIME = 0.01  # s to the contact: the middle of a control step
SEED = 3


def throw(worlds: Worlds, speed: Tensor) -> tuple[Tensor, Tensor]:
    """Position and velocity (N, 3) of balls that hit the blades THROW_TIME later, at ``speed`` (N,) m/s along the
    normal and up to 5 cm off their centres."""
    paddle = worlds.kinematics.paddle_path[:, -1]
    centre, normal, velocity, turning = paddle.split(3, dim=1)
    uniform = torch.rand(len(speed), 3, generator=torch.Generator().manual_seed(SEED)) - 0.5
    across = uniform - (uniform * normal).sum(1, keepdim=True) * normal
    offset = 0.05 * across / across.norm(dim=1, keepdim=True) * uniform[:, :1].abs() * 2
    at_once = velocity + torch.linalg.cross(turning, offset)
    approach = at_once - speed.unsqueeze(1) * normal
    touching = worlds.config.ball.radius + worlds.config.ball.table.paddle_half_thickness
    meeting = centre + offset + touching * normal + THROW_TIME * at_once
    return meeting - THROW_TIME * approach, approach
