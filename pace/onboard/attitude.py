"""The robot's orientation: gyroscope over short times, sensed gravity and heading over long ones."""

from __future__ import annotations

import torch
import warp as wp

from pace.arrays.share import share
from pace.config.task import AttitudeEstimateConfig
from pace.onboard.estimate import Estimate
from pace.onboard.kernels import ATTITUDE_SIZE, DOWN, FORWARD, TURNING, estimate_attitude
from pace.sim.sensing import Sensing


class AttitudeEstimate(Estimate):
    """A complementary filter of each world's orientation, as the inertial unit of a robot has it.

    Each control step the last estimate is turned on by the gyroscope, and ``gain`` of it is replaced by what is sensed.
    With the paper's noise (gravity and heading +-0.05 a step, 0.03 in root mean square) and a gain of 0.1 gravity is
    known to 0.007, heading to 0.009: 0.8 m away, at the paddle, 7 mm instead of 24. A turn is known at once, however
    late motion capture is.

    Attributes: ``state`` (N, 9): all that is remembered (:func:`pace.onboard.kernels.estimate_attitude` has the
    columns); in it ``gravity`` (N, 3) unit vectors, body frame, and ``heading`` (N, 2), the x axis of the trunk on the
    ground; ``quat`` (N, 4) w, x, y, z, the base's orientation from both. A new episode begins with what is sensed.

    Args:
        config: numbers of the filter.
        control_dt: s.
        sensing: the robot's sensors.
    """

    def __init__(self, config: AttitudeEstimateConfig, control_dt: float, sensing: Sensing) -> None:
        turning = sensing.base_angular_velocity
        count, device = turning.shape[0], turning.device
        self.state = torch.zeros(count, ATTITUDE_SIZE, device=device)
        self.gravity, self.heading = self.state[:, DOWN:FORWARD], self.state[:, FORWARD:TURNING]
        self.quat = torch.zeros(count, 4, device=device)
        sensed = [share(turning), share(sensing.projected_gravity), wp.from_torch(sensing.heading)]
        kept = [wp.from_torch(self.state), wp.from_torch(self.quat, dtype=wp.vec4)]
        super().__init__(estimate_attitude, [*sensed, control_dt, config.gain, *kept], count, device)
