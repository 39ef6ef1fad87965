"""Joint positions and velocities, filtered over several control steps."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pace.config.task import JointEstimateConfig
from pace.onboard.estimate import Estimate, Part

SETTLED = 1e-12  # relative change of the filter's covariance at convergence
LONGEST = 100_000  # control steps allowed until convergence


class JointEstimate(Estimate):
    """A Kalman filter of each joint with a constant-velocity model: steady gains, no model of the robot.

    With the paper's noise (+-0.01 rad and +-1.5 rad/s, root mean square 0.0058 and 0.87) the error for a playing robot
    is 0.0053 rad and 0.47 rad/s; with twice the noise (0.012 and 1.7) it is 0.010 and 0.77. An episode begins with the
    sensed values.

    Args: config: numbers of the filter; control_dt: s; joints: J.
    """

    def __init__(self, config: JointEstimateConfig, control_dt: float, joints: int) -> None:
        super().__init__(config, control_dt, joints)
        (self.near, self.nudge), (self.pull, self.follow) = steady_gain(config, control_dt).tolist()

    @staticmethod
    def parts(joints: int) -> dict[str, Part]:
        """See :class:`Estimate`."""
        return {
            "known": Part(1, "1", "1"),
            "position": Part(joints, "rad", "estimated positions, relative to the nominal pose"),
            "velocity": Part(joints, "rad/s", "estimated velocities"),
        }

    def begin(self, joint_position: Tensor, joint_velocity: Tensor) -> Tensor:
        """The state (N, 1 + 2 J) from (N, J) rad, relative to the nominal pose, and (N, J) rad/s."""
        return torch.cat((torch.ones_like(joint_position[:, :1]), joint_position, joint_velocity), dim=1)

    def forward(self, state: Tensor, joint_position: Tensor, joint_velocity: Tensor) -> Tensor:
        """The state (N, 1 + 2 J) after this step; readings as those of :meth:`begin`."""
        last, speed = state[:, self.columns["position"]], state[:, self.columns["velocity"]]
        said = last + self.control_dt * speed
        off, faster = joint_position - said, joint_velocity - speed
        position = said + self.near * off + self.nudge * faster
        velocity = speed + self.pull * off + self.follow * faster
        return torch.cat((state[:, :1], position, velocity), dim=1)


def steady_gain(config: JointEstimateConfig, control_dt: float) -> NDArray[np.float64]:
    """Kalman gain (2, 2) after many control steps: rows position and velocity, columns their innovations.

    Within a control step a joint has a constant acceleration, sampled independently for each step with root mean square
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
