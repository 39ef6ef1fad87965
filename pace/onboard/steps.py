"""What a robot keeps over an episode, in torch, for exported policies.

See :mod:`pace.onboard.returns`, :mod:`pace.onboard.delay`, :mod:`pace.onboard.attitude` and :mod:`pace.onboard.joints`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from pace.config.task import AttitudeEstimateConfig, DelayEstimateConfig, JointEstimateConfig, ReturnMemoryConfig
from pace.onboard.joints import steady_gain
from pace.onboard.kernels import AGE, BEFORE, NORMAL_1, POSITION_1, POSITION_2, RETURN, SMALLEST_TILT
from pace.sim.ball.aero import GRAVITY


class ReturnMemoryStep(nn.Module):
    """One control step of the memory, as the kernel :func:`pace.onboard.kernels.remember_return` computes it.

    Args: config: numbers of the estimate; control_dt: s.
    """

    def __init__(self, config: ReturnMemoryConfig, control_dt: float) -> None:
        super().__init__()
        self.config, self.span = config, 2.0 * control_dt
        # in the two steps to the hit, and from it
        self.register_buffer("fall", torch.tensor([0.0, 0.0, self.span * GRAVITY]))

    fall: Tensor

    def forward(self, memory: Tensor, track: Tensor, turned: Tensor, paddle: Tensor, normal: Tensor) -> Tensor:
        """The memory (N, 24) after this step.

        Args: memory (N, 24) before it; track (N, 3 * frames) m, the ball's last positions, oldest first; turned (N, 1)
        bool, the ball has been seen moving away; paddle (N, 3) m and normal (N, 3) of the paddle.
        """
        ball = track.unflatten(1, (-1, 3))
        newest, speed = ball[:, -1], (ball[:, -1] - ball[:, -3]) / self.span
        age = torch.where(turned, (memory[:, AGE : AGE + 1] + 1.0).clamp(max=4.0), 0.0)
        turning, leaving = age == 1.0, age == 3.0
        before = (ball[:, -3] - ball[:, -5]) / self.span - self.fall
        swing = (paddle - memory[:, POSITION_2:NORMAL_1]) / self.span
        hit = torch.cat((before, swing, memory[:, NORMAL_1:BEFORE]), dim=1)
        hit = torch.where(turning, hit, memory[:, BEFORE:RETURN])
        far = (newest - paddle).square().sum(1, keepdim=True).sqrt() > self.config.reach
        age = torch.where(turning & far, 4.0, age)  # not the paddle turned it
        seen = torch.where(leaving, self._learn(hit, speed, memory[:, RETURN:]), memory[:, RETURN:])
        return torch.cat((age, paddle, memory[:, POSITION_1:POSITION_2], normal, hit, seen), dim=1)

    def _learn(self, hit: Tensor, after: Tensor, seen: Tensor) -> Tensor:
        """What is seen (N, 5) with one more estimate.

        Args: hit (N, 9): velocity of the ball before it and of the paddle, m/s, and the paddle's normal; after (N, 3)
        m/s, velocity of the return; seen (N, 5) so far.
        """
        config = self.config
        before, paddle, normal = hit.split(3, dim=1)
        restitution, share = seen[:, 3:4], seen[:, 4:5]
        closing = ((before - paddle) * normal).sum(1, keepdim=True)
        parting = ((after + self.fall - paddle) * normal).sum(1, keepdim=True)
        fast = closing.abs() >= config.closing_speed
        estimate = (-parting / torch.where(fast, closing, 1.0)).clamp(0.0, config.largest)
        hits = (share * config.hits).clamp(max=config.hits - 1.0)  # older ones fade once there are that many
        weight = hits + config.prior_hits
        mean = (restitution * weight + estimate - config.prior) / (weight + 1.0)
        learned = torch.cat((mean, (hits + 1.0) / config.hits), dim=1)
        return torch.cat((after, torch.where(fast, learned, seen[:, 3:])), dim=1)


class DelayEstimateStep(nn.Module):
    """One control step of the estimate, as the kernel :func:`pace.onboard.kernels.estimate_delay` computes it.

    Args: config: numbers of the estimate; control_dt: s.
    """

    def __init__(self, config: DelayEstimateConfig, control_dt: float) -> None:
        super().__init__()
        self.config, self.control_dt = config, control_dt

    def forward(self, kept: Tensor, angular_velocity: Tensor, gravity: Tensor, heading: Tensor) -> Tensor:
        """What is kept (N, 8) after this step.

        Args: kept (N, 8) before it, zeros at first; angular_velocity (N, 3) rad/s and gravity (N, 3), body frame;
        heading (N, 2).
        """
        config = self.config
        known, last_yaw, last_rate, behind, change, products, squares, _ = kept.split(1, dim=1)
        rate = yaw_rate(gravity, angular_velocity)
        yaw = torch.atan2(heading[:, 1:], heading[:, :1])
        turn = yaw - last_yaw
        turn = turn - 2.0 * math.pi * torch.round(turn / (2.0 * math.pi))
        said = 0.5 * self.control_dt * (rate + last_rate)
        behind = config.smoothing * behind + said - turn
        change = config.smoothing * change + rate - last_rate
        products = config.fading * products + change * behind
        squares = config.fading * squares + change.square()
        estimate = (products - config.prior * squares) / (squares + config.prior_worth)
        learned = known * torch.cat((behind, change, products, squares, estimate), dim=1)  # zeros at first
        return torch.cat((torch.ones_like(known), yaw, rate, learned), dim=1)


def yaw_rate(gravity: Tensor, angular_velocity: Tensor) -> Tensor:
    """(N, 1) rad/s, of the trunk's x axis on the ground, from (N, 3) each, body frame."""
    tilt = gravity[:, 1:].square().sum(1, keepdim=True).clamp(min=SMALLEST_TILT)
    return -(gravity[:, 1:] * angular_velocity[:, 1:]).sum(1, keepdim=True) / tilt


class AttitudeEstimateStep(nn.Module):
    """One control step of the filter, as the kernel :func:`pace.onboard.kernels.estimate_attitude` computes it.

    Args: config: numbers of the filter; control_dt: s.
    """

    def __init__(self, config: AttitudeEstimateConfig, control_dt: float) -> None:
        super().__init__()
        self.gain, self.control_dt = config.gain, control_dt

    def forward(self, kept: Tensor, angular_velocity: Tensor, gravity: Tensor, heading: Tensor) -> Tensor:
        """What is kept (N, 9) after this step: 1, gravity, heading, angular velocity.

        Args: kept (N, 9) before it, zeros at first; angular_velocity (N, 3) rad/s and gravity (N, 3), body frame;
        heading (N, 2).
        """
        known, last, forward, turning = kept.split([1, 3, 2, 3], dim=1)
        mean = 0.5 * (angular_velocity + turning)
        turned = last + self.control_dt * torch.linalg.cross(last, mean)
        down = functional.normalize((1.0 - self.gain) * turned + self.gain * gravity, dim=1)
        angle = self.control_dt * yaw_rate(down, mean)
        along = torch.cat((-forward[:, 1:], forward[:, :1]), dim=1)
        swept = forward * torch.cos(angle) + along * torch.sin(angle)
        ahead = (1.0 - self.gain) * swept + self.gain * heading
        seen = known > 0.5
        down, ahead = torch.where(seen, down, gravity), torch.where(seen, ahead, heading)
        parts = (functional.normalize(down, dim=1), functional.normalize(ahead, dim=1), angular_velocity)
        return torch.cat((torch.ones_like(known), *parts), dim=1)


class JointEstimateStep(nn.Module):
    """One control step of the filter, as the kernel :func:`pace.onboard.kernels.estimate_joints` computes it.

    Args: config: numbers of the filter; control_dt: s.
    """

    def __init__(self, config: JointEstimateConfig, control_dt: float) -> None:
        super().__init__()
        self.control_dt = control_dt
        (self.near, self.nudge), (self.pull, self.follow) = steady_gain(config, control_dt).tolist()

    def forward(self, kept: Tensor, position: Tensor, velocity: Tensor) -> Tensor:
        """What is kept (N, 1 + 2 J) after this step: 1, positions, velocities.

        Args: kept (N, 1 + 2 J) before it, zeros at first; position (N, J) rad, relative to the nominal pose, and
        velocity (N, J) rad/s, both as sensed.
        """
        count = position.shape[1]
        known, last, speed = kept.split([1, count, count], dim=1)
        said = last + self.control_dt * speed
        off, faster = position - said, velocity - speed
        seen = known > 0.5
        at = torch.where(seen, said + self.near * off + self.nudge * faster, position)
        moving = torch.where(seen, speed + self.pull * off + self.follow * faster, velocity)
        return torch.cat((torch.ones_like(known), at, moving), dim=1)
