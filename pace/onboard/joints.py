"""The robot's joints: positions and velocities that are better known over several control steps than from one."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from pace.config.task import JointEstimateConfig
from pace.onboard.estimate import Estimate
from pace.onboard.kernels import FIRST_JOINT, estimate_joints
from pace.sim.sensing import Sensing

SETTLED = 1e-12  # relative change of the filter's covariance at which its gain is taken
LONGEST = 100_000  # control steps that it may take to settle


class JointEstimate(Estimate):
    """A Kalman filter of each joint, which moves on at the velocity it has: steady gains, no model of the robot.

    With the paper's noise (+-0.01 rad and +-1.5 rad/s, 0.0058 and 0.87 in root mean square) joints of a robot that
    plays are known to 0.0053 rad and 0.47 rad/s, with twice the noise to 0.010 and 0.77 (of 0.012 and 1.7).

    Attributes: ``state`` (N, 1 + 2 J): 1 once anything was seen, then ``position`` (N, J) rad relative to the nominal
    pose and ``velocity`` (N, J) rad/s. A new episode begins with what is sensed.

    Args:
        config: numbers of the filter.
        control_dt: s.
        sensing: the robot's sensors.
    """

    def __init__(self, config: JointEstimateConfig, control_dt: float, sensing: Sensing) -> None:
        sensed = sensing.joint_position
        count, joints = sensed.shape
        self.state = torch.zeros(count, FIRST_JOINT + 2 * joints, device=sensed.device)
        self.position, self.velocity = self.state[:, FIRST_JOINT:].split(joints, dim=1)
        gain = wp.mat22(*steady_gain(config, control_dt).ravel().tolist())
        readings = [wp.from_torch(sensed), wp.from_torch(sensing.joint_velocity)]
        super().__init__(
            estimate_joints, [*readings, control_dt, gain, wp.from_torch(self.state)], count, sensed.device
        )


def steady_gain(config: JointEstimateConfig, control_dt: float) -> NDArray[np.float64]:
    """Kalman gain (2, 2) after many control steps: what position and velocity gain from either's innovation.

    Between two of them a joint is accelerated by a constant, drawn anew each time with root mean square
    ``config.acceleration``. Source: Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2.
    """
    step = np.array([[1.0, control_dt], [0.0, 1.0]])
    pushed = np.array([0.5 * control_dt**2, control_dt]) * config.acceleration
    noise = np.diag([config.position_noise**2, config.velocity_noise**2])
    after = noise
    gain = np.eye(2)
    for _ in range(LONGEST):
        before = step @ after @ step.T + np.outer(pushed, pushed)
        gain = before @ np.linalg.inv(before + noise)
        settled, after = after, (np.eye(2) - gain) @ before
        if np.abs(after - settled).max() <= SETTLED * np.abs(after).max():
            break
    return gain
