"""What the robot's sensors report: delayed motion capture, noisy proprioception.

Everything that an actor may see of the world passes through :class:`Sensing`; it never hands out a true value.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pace.config import SensingConfig

if TYPE_CHECKING:
    from pace.sim.worlds import RobotState

MOCAP_COLUMNS = 8  # base position 3, ball position 3, heading 2
BALL = slice(3, 6)  # the ball's columns among them
SHIFT_COLUMNS = 2  # noise for the base shift, which is computed from sensed values and has noise of its own


class Sensing:
    """Sensed signals of N worlds, overwritten in place once a control step.

    Proprioception has uniform noise; motion capture (base position, heading, ball) is also late by a delay that is
    drawn per world at reset, linearly interpolated between the control steps around it. A new ball is a new track of
    the motion-capture system: its first sample is its first position.

    Attributes: ``base_angular_velocity`` (N, 3) rad/s body frame, ``projected_gravity`` (N, 3), ``joint_position``
    (N, J) rad from the nominal pose, ``joint_velocity`` (N, J) rad/s, ``base_position`` (N, 3) m,
    ``ball_position`` (N, 3) m, ``heading`` (N, 2), ``base_shift_noise`` (N, 2) m; world frame unless said.
    """

    def __init__(
        self,
        config: SensingConfig,
        num_worlds: int,
        device: torch.device,
        control_dt: float,
        nominal: Tensor,
        generator: torch.Generator,
    ) -> None:
        joints = nominal.shape[0]
        self._low, self._high = (bound / control_dt for bound in config.mocap_delay)
        self._generator = generator
        self._nominal = nominal
        self._mocap = slice(6 + 2 * joints, 6 + 2 * joints + MOCAP_COLUMNS)
        columns = self._mocap.stop
        self._noise = torch.zeros(num_worlds, columns + SHIFT_COLUMNS, device=device)
        self._amplitude = self._amplitudes(config, joints).to(device)
        self._truth = torch.zeros(num_worlds, columns, device=device)
        self._sensed = torch.zeros(num_worlds, columns + SHIFT_COLUMNS, device=device)
        frames = max(2, math.ceil(self._high) + 1)
        self._line = torch.zeros(frames, num_worlds, MOCAP_COLUMNS, device=device)  # newest first
        self._weight = torch.zeros(frames, num_worlds, 1, device=device)
        self._weight[0] = 1.0
        self._steps_back = torch.arange(frames, device=device, dtype=torch.float32).view(-1, 1, 1)
        self._bind(joints)

    @staticmethod
    def _amplitudes(config: SensingConfig, joints: int) -> Tensor:
        parts = (
            (3, config.base_angular_velocity),
            (3, config.projected_gravity),
            (joints, config.joint_position),
            (joints, config.joint_velocity),
            (3, config.base_position),
            (3, config.ball_position),
            (2, config.heading),
            (SHIFT_COLUMNS, config.base_shift),
        )
        return torch.cat([torch.full((size,), amplitude) for size, amplitude in parts])

    def _bind(self, joints: int) -> None:
        sizes = [3, 3, joints, joints, 3, 3, 2, SHIFT_COLUMNS]
        views = torch.split(self._sensed, sizes, dim=1)
        self.base_angular_velocity, self.projected_gravity, self.joint_position, self.joint_velocity = views[:4]
        self.base_position, self.ball_position, self.heading, self.base_shift_noise = views[4:]

    def update(self, robot: RobotState, ball_position: Tensor, new_ball: Tensor) -> None:
        """One control step later: sense the state; ``new_ball`` (N,) bool marks balls that were just launched."""
        self._read(robot, ball_position)
        for older in range(self._line.shape[0] - 1, 0, -1):
            self._line[older].copy_(self._line[older - 1])
        self._line[0].copy_(self._truth[:, self._mocap])
        launched = new_ball.unsqueeze(-1)
        for frame in self._line[1:]:
            torch.where(launched, self._line[0, :, BALL], frame[:, BALL], out=frame[:, BALL])
        self._add_delay_and_noise(self._sensed)

    def reset(self, mask: Tensor, robot: RobotState, ball_position: Tensor) -> None:
        """Draw new delays for the worlds of ``mask`` (N,) bool and sense them as if they had stood still so far."""
        wide = mask.unsqueeze(-1)
        self._read(robot, ball_position)
        delay = torch.rand(wide.shape, device=wide.device, generator=self._generator)
        delay = delay.mul_(self._high - self._low).add_(self._low)
        hat = (1.0 - (delay - self._steps_back).abs()).clamp_(min=0.0)  # linear interpolation
        self._weight.copy_(torch.where(wide, hat, self._weight))
        self._line.copy_(torch.where(wide, self._truth[:, self._mocap], self._line))
        sensed = torch.empty_like(self._sensed)
        self._add_delay_and_noise(sensed)
        self._sensed.copy_(torch.where(wide, sensed, self._sensed))

    def _read(self, robot: RobotState, ball_position: Tensor) -> None:
        signals = (
            robot.base_angular_velocity,
            robot.projected_gravity,
            robot.joint_position - self._nominal,
            robot.joint_velocity,
            robot.base_position,
            ball_position,
            robot.heading,
        )
        torch.cat(signals, dim=1, out=self._truth)

    def _add_delay_and_noise(self, out: Tensor) -> None:
        self._noise.uniform_(-1.0, 1.0, generator=self._generator)
        torch.mul(self._noise, self._amplitude, out=out)
        columns = self._mocap.start
        out[:, :columns].add_(self._truth[:, :columns])
        out[:, self._mocap].add_((self._weight * self._line).sum(0))


def base_orientation(projected_gravity: Tensor, heading: Tensor) -> Tensor:
    """Base quaternion (N, 4) w, x, y, z from gravity in the body frame (N, 3) and heading on the ground (N, 2).

    Gravity gives roll and pitch, heading gives yaw (R = Rz Ry Rx); neither needs to have unit length.
    """
    x, y, z = projected_gravity.unbind(1)
    roll = torch.atan2(-y, -z)
    pitch = torch.atan2(x, torch.hypot(y, z))
    yaw = torch.atan2(heading[:, 1], heading[:, 0])
    half = 0.5 * torch.stack((roll, pitch, yaw))
    (cr, cp, cy), (sr, sp, sy) = torch.cos(half), torch.sin(half)
    quat = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    return torch.stack(quat, dim=1)
