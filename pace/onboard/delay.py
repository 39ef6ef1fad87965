"""Delay of motion capture: its yaw against the gyroscope's, as in the temporal calibration of cameras and IMUs."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pace.config.task import DelayEstimateConfig
from pace.onboard.attitude import yaw_rate
from pace.onboard.estimate import Estimate, Part


class DelayEstimate(Estimate):
    """The delay of each robot's motion capture, from the turns of its trunk since the episode began.

    The gyroscope reports a turn at once, motion capture ``delay`` seconds later: yaw(t) = psi(t) - delay * rate(t), as
    long as the rate changes little within the delay. Differences from step to step, smoothed by the same filter on both
    sides, do not depend on the initial yaw:

        behind = F[rate dt - yaw step] = delay * F[rate step] = delay * change

    and least squares over all steps, with a prior, is the estimate: (sum change * behind + prior * worth) /
    (sum change^2 + worth). One swing at 4 rad/s outweighs the prior.

    Args: config: numbers of the estimate; control_dt: s; joints: J.
    """

    config: DelayEstimateConfig

    @staticmethod
    def parts(joints: int) -> dict[str, Part]:
        """See :class:`Estimate`."""
        return {
            "known": Part(1, "1", "1"),
            "yaw": Part(1, "rad", "sensed one step ago"),
            "rate": Part(1, "rad/s", "of the yaw, one step ago"),
            "behind": Part(1, "rad", "filtered: lag of the sensed yaw behind the integrated rate"),
            "change": Part(1, "rad/s", "filtered: change of the rate"),
            "products": Part(1, "rad^2/s", "sum of change times behind"),
            "squares": Part(1, "rad^2/s^2", "sum of the squares of change"),
            "delay": Part(1, "s", "estimated delay of motion capture above the prior"),
        }

    def begin(self, base_angular_velocity: Tensor, projected_gravity: Tensor, heading: Tensor) -> Tensor:
        """The state (N, 8) from (N, 3) rad/s and (N, 3), body frame, and (N, 2), world frame; delay: the prior."""
        yaw, rate = _yaw(heading), yaw_rate(projected_gravity, base_angular_velocity)
        return torch.cat((torch.ones_like(yaw), yaw, rate, torch.zeros_like(yaw).expand(-1, 5)), dim=1)

    def forward(
        self, state: Tensor, base_angular_velocity: Tensor, projected_gravity: Tensor, heading: Tensor
    ) -> Tensor:
        """The state (N, 8) after this step; readings as those of :meth:`begin`."""
        config = self.config
        known, last_yaw, last_rate, behind, change, products, squares, _ = state.split(1, dim=1)
        yaw, rate = _yaw(heading), yaw_rate(projected_gravity, base_angular_velocity)
        turn = yaw - last_yaw
        turn = turn - 2.0 * math.pi * torch.round(turn / (2.0 * math.pi))
        said = 0.5 * self.control_dt * (rate + last_rate)
        behind = config.smoothing * behind + said - turn
        change = config.smoothing * change + rate - last_rate
        products = config.fading * products + change * behind
        squares = config.fading * squares + change.square()
        delay = (products - config.prior * squares) / (squares + config.prior_worth)
        return torch.cat((known, yaw, rate, behind, change, products, squares, delay), dim=1)


def _yaw(heading: Tensor) -> Tensor:
    return torch.atan2(heading[:, 1:], heading[:, :1])
