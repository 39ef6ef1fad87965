"""Memory of the robot's returns: their velocity after the hit, and the restitution estimated from it."""

from __future__ import annotations

import torch
from torch import Tensor

from pace.config.task import ReturnMemoryConfig
from pace.onboard.estimate import Estimate, Part
from pace.sim.ball.aero import GRAVITY

#: Frames of the ball's track that a hit is estimated from.
FRAMES = 5


class ReturnMemory(Estimate):
    """The returns of each robot since its episode began, from sensed signals alone.

    If the ball is first sensed moving away near the paddle, it was hit about one control step earlier. The ball's
    sensed positions give its velocity before the hit (from four to two steps before it was seen to turn) and after it
    (over the next two steps). Forward kinematics gives velocity and normal of the paddle one step earlier. With them

        e = -(v_after - v_paddle) . n / (v_before - v_paddle) . n

    is one estimate of the restitution. The robot's estimate for its paddle and ball is the mean of all, in which the
    prior counts as so many hits. Single estimates are rough: noise of the ball's positions alone adds an error of 0.03,
    and the paddle's velocity changes within the step of the hit.

    Args: config: numbers of the estimate; control_dt: s; joints: J.
    """

    fall: Tensor

    def __init__(self, config: ReturnMemoryConfig, control_dt: float, joints: int) -> None:
        super().__init__(config, control_dt, joints)
        self.span = 2.0 * control_dt
        # in the two steps before the hit, and after it
        self.register_buffer("fall", torch.tensor([0.0, 0.0, self.span * GRAVITY]), persistent=False)

    @staticmethod
    def parts(joints: int) -> dict[str, Part]:
        """See :class:`Estimate`."""
        return {
            "age": Part(1, "1", "control steps since the ball was seen to turn, at most 4; 0: it has not turned"),
            "last_position": Part(3, "m", "paddle one step ago, world frame"),
            "second_last_position": Part(3, "m", "paddle two steps ago"),
            "last_normal": Part(3, "1", "normal of the paddle one step ago"),
            "hit": Part(9, "m/s, m/s, 1", "velocity of the ball before the hit and of the paddle, and its normal"),
            "last_return": Part(
                5,
                "m/s, 1, 1",
                "velocity of the last return, world frame (0 before the first); estimated restitution minus the prior; "
                "hits that it is the mean of, as a share of observation.return_memory.hits",
            ),
        }

    def begin(self, track: Tensor, turned: Tensor, paddle_position: Tensor, paddle_normal: Tensor) -> Tensor:
        """The state (N, ``size``): zeros."""
        return paddle_position.new_zeros(1, self.size).expand(paddle_position.shape[0], -1)

    def forward(
        self, state: Tensor, track: Tensor, turned: Tensor, paddle_position: Tensor, paddle_normal: Tensor
    ) -> Tensor:
        """The state (N, ``size``) after this step.

        Args: state (N, ``size``) before it; track (N, 3 * frames) m, the ball's last positions, oldest first;
        turned (N,) bool, the ball was sensed moving away; position (N, 3) m and normal (N, 3) of the paddle.
        """
        columns = [1, 3, 3, 3, 9, self.size - 19]
        last_age, last, second_last, last_normal, last_hit, seen = state.split(columns, dim=1)
        ball = track.unflatten(1, (-1, 3))
        newest, speed = ball[:, -1], (ball[:, -1] - ball[:, -3]) / self.span
        age = torch.where(turned.unsqueeze(1), (last_age + 1.0).clamp(max=4.0), 0.0)
        turning, leaving = age == 1.0, age == 3.0
        before = (ball[:, -3] - ball[:, -5]) / self.span - self.fall
        swing = (paddle_position - second_last) / self.span
        hit = torch.where(turning, torch.cat((before, swing, last_normal), dim=1), last_hit)
        far = (newest - paddle_position).square().sum(1, keepdim=True).sqrt() > self.config.reach
        age = torch.where(turning & far, 4.0, age)  # turned by something other than the paddle
        seen = torch.where(leaving, self._learn(hit, speed, seen), seen)
        return torch.cat((age, paddle_position, last, paddle_normal, hit, seen), dim=1)

    def _learn(self, hit: Tensor, after: Tensor, seen: Tensor) -> Tensor:
        """``last_return`` (N, 5) with one more estimate.

        Args: hit (N, 9): velocity of the ball before it and of the paddle, m/s, and the paddle's normal; after (N, 3)
        m/s, velocity of the return; seen (N, 5) so far.
        """
        config = self.config
        before, paddle, normal = hit.split(3, dim=1)
        closing = ((before - paddle) * normal).sum(1, keepdim=True)
        parting = ((after + self.fall - paddle) * normal).sum(1, keepdim=True)
        fast = closing.abs() >= config.closing_speed
        estimate = (-parting / torch.where(fast, closing, 1.0)).clamp(0.0, config.largest) - config.prior
        return torch.cat((after, self._mean(seen[:, 3:5], estimate, fast)), dim=1)

    def _mean(self, known: Tensor, estimate: Tensor, counts: Tensor) -> Tensor:
        """A mean and the share of hits that it is of, ``known`` (N, 2), with one more ``estimate`` (N, 1), both minus
        the prior, where it ``counts`` (N, 1) bool; with more than ``hits``, older ones fade."""
        config = self.config
        mean, share = known.split(1, dim=1)
        hits = (share * config.hits).clamp(max=config.hits - 1.0)
        weight = hits + config.prior_hits
        learned = torch.cat(((mean * weight + estimate) / (weight + 1.0), (hits + 1.0) / config.hits), dim=1)
        return torch.where(counts, learned, known)
