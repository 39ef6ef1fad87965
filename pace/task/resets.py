"""Initial states of serves and robots: samplers over N worlds."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from pace.arrays.draws import Column, UniformSampler, columns_of
from pace.arrays.launch import Launch
from pace.config.sim import RobotConfig
from pace.config.task import ResetConfig, ServeConfig
from pace.sim.ball.ball import BallSim
from pace.sim.robot_spec import RobotSpec


@wp.kernel
def turn(yaw: wp.array[wp.float32], qpos: wp.array2d[wp.float32]):
    """The quaternion of a robot that stands upright, turned by ``yaw`` rad."""
    world = wp.tid()
    qpos[world, 3] = wp.cos(0.5 * yaw[world])
    qpos[world, 6] = wp.sin(0.5 * yaw[world])


class ServeSampler:
    """Samples the initial position, velocity and spin of serves."""

    def __init__(
        self, config: ServeConfig, num_worlds: int, generator: torch.Generator, device: torch.device | str
    ) -> None:
        launch = torch.zeros(num_worlds, 9, device=device)
        self._launch = launch[:, :3], launch[:, 3:6], launch[:, 6:]
        ranges = [config.x, config.y, config.z, config.vx, config.vy, config.vz, config.spin, config.spin, config.spin]
        self._sample = UniformSampler(columns_of(launch, ranges), generator)

    def sample(self, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Position m, velocity m/s and spin rad/s, each (N, 3), world frame: new in the worlds of ``mask`` (N,) bool.

        The tensors are allocated once and updated in place.
        """
        self._sample(mask)
        return self._launch


class HeadStart:
    """Moves served balls forward on their flight, by a time sampled from ``config.head_start``."""

    def __init__(self, config: ServeConfig, ball: BallSim, generator: torch.Generator) -> None:
        duration = torch.zeros(ball.num_worlds, device=ball.device)
        self._sample = UniformSampler([Column(duration, *config.head_start)], generator)
        self._skip = ball.skipper(duration)

    def give(self, mask: Tensor) -> None:
        """Sample a time for each world of ``mask`` (N,) bool and move its ball forward by it."""
        self._sample(mask)
        self._skip(mask)


class PoseSampler:
    """Samples the state in which a robot starts an episode."""

    def __init__(
        self,
        config: ResetConfig,
        robot: RobotConfig,
        num_worlds: int,
        nominal: Tensor,
        limits: tuple[Tensor, Tensor],
        generator: torch.Generator,
    ) -> None:
        device, joints = nominal.device, nominal.shape[0]
        self._qpos = torch.zeros(num_worlds, 7 + joints, device=device)
        self._qvel = torch.zeros(num_worlds, 6 + joints, device=device)
        self._qpos[:, 2] = robot.base_height
        yaw = torch.zeros(num_worlds, device=device)
        columns = columns_of(self._qpos[:, :2], [config.base_x, config.base_y])
        columns.append(Column(yaw, *config.yaw))
        rates = [config.roll_pitch_rate, config.roll_pitch_rate, config.yaw_rate]
        columns += columns_of(self._qvel[:, :6], [*[config.linear_velocity] * 3, *rates])
        ends = zip(*(limit.tolist() for limit in limits), strict=True)
        ranges = _joint_ranges(config, RobotSpec.of(robot), nominal.tolist())
        columns += columns_of(self._qpos[:, 7:], [(*pair, *end) for pair, end in zip(ranges, ends, strict=True)])
        self._sample = UniformSampler(columns, generator)
        self._turn = Launch(turn, num_worlds, device, yaw=yaw, qpos=self._qpos)

    def sample(self, mask: Tensor) -> tuple[Tensor, Tensor]:
        """qpos (N, 7 + J) and qvel (N, 6 + J) of MuJoCo; joints within their limits and at rest.

        New in the worlds of ``mask`` (N,) bool; the tensors are allocated once and updated in place.
        """
        self._sample(mask)
        self._turn()
        return self._qpos, self._qvel


def _joint_ranges(config: ResetConfig, spec: RobotSpec, nominal: list[float]) -> list[tuple[float, float]]:
    """Lowest and highest angle of each joint at the start of an episode, rad."""
    ranges = []
    for name, angle in zip(spec.joints, nominal, strict=True):
        if name in spec.arm:
            low, high = (angle + end for end in config.right_arm_offset)
        else:
            low, high = (angle * end for end in config.joint_scale)
        ranges.append((low, high))
    return ranges
