"""How late motion capture is: its yaw against the gyroscope's, as cameras and inertial units are calibrated in time."""

from __future__ import annotations

import torch
import warp as wp

from pace.arrays.share import share
from pace.config.task import DelayEstimateConfig
from pace.onboard.estimate import Estimate
from pace.onboard.kernels import DELAY_SIZE, DelayRules, estimate_delay
from pace.sim.sensing import Sensing


class DelayEstimate(Estimate):
    """The delay of each world's motion capture, from the turns of its trunk since the episode began.

    The gyroscope reports a turn at once, motion capture ``delay`` seconds later: yaw(t) = psi(t) - delay * rate(t), as
    long as the rate changes little within the delay. Differences from step to step, smoothed by the same filter on both
    sides, leave out where the yaw began:

        behind = F[rate dt - yaw step] = delay * F[rate step] = delay * change

    and least squares over all steps, with a prior, is the estimate: (sum change * behind + prior * worth) /
    (sum change^2 + worth). One swing at 4 rad/s is worth as much as the prior and more.

    Attributes: ``state`` (N, 8): all that is remembered (columns: :func:`pace.onboard.kernels.estimate_delay`);
    ``seen`` (N, 1) s: the estimate minus the prior, its last column. A new episode begins with 0.

    Args:
        config: numbers of the estimate.
        control_dt: s.
        sensing: the robot's sensors.
    """

    def __init__(self, config: DelayEstimateConfig, control_dt: float, sensing: Sensing) -> None:
        turning = sensing.base_angular_velocity
        count, device = turning.shape[0], turning.device
        self.state = torch.zeros(count, DELAY_SIZE, device=device)
        self.seen = self.state[:, -1:]
        arrays = [share(turning), share(sensing.projected_gravity), wp.from_torch(sensing.heading)]
        inputs = [*arrays, delay_rules(config, control_dt), wp.from_torch(self.state)]
        super().__init__(estimate_delay, inputs, count, device)


def delay_rules(config: DelayEstimateConfig, control_dt: float) -> DelayRules:
    """The numbers in the kernel's form."""
    rules = DelayRules()
    rules.control_dt = control_dt
    rules.prior, rules.prior_worth = config.prior, config.prior_worth
    rules.smoothing, rules.fading = config.smoothing, config.fading
    return rules
