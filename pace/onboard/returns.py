"""What the robot remembers of its own returns: how they left the paddle, and what that says about its restitution."""

from __future__ import annotations

from collections.abc import Callable

import torch
import warp as wp
from torch import Tensor

from pace.arrays.share import record, share
from pace.config.task import ReturnMemoryConfig
from pace.onboard.kernels import MEMORY_SIZE, MemoryRules, remember_return

#: Numbers that the actor sees: velocity of the last return 3, restitution above the prior 1, share of hits 1.
SEEN = 5


class ReturnMemory:
    """The returns of each world's robot since its episode began, from sensed signals alone.

    A ball that is first seen moving away near the paddle was hit about one control step before. Its sensed positions
    give its velocity before (from four to two steps before it was seen to turn) and after (the two steps from then on),
    forward kinematics gives velocity and normal of the paddle one step before. With them

        e = -(v_after - v_paddle) . n / (v_before - v_paddle) . n

    is one estimate of the restitution; the mean of all, with the prior as so many hits more, is what the robot knows
    of its paddle and ball. Single estimates are rough: noise of the ball's positions alone is worth 0.03, and the
    paddle's velocity changes within the step in which the hit falls.

    Attributes: ``seen`` (N, 5): velocity of the last return m/s, world frame (0 before the first), estimated
    restitution minus the prior, hits that it is the mean of as a share of ``config.hits``; ``state`` (N, 24): all that
    is remembered, ``seen`` in its last columns (:func:`pace.onboard.kernels.remember_return` has the others). A new
    episode begins with zeros.

    Args:
        config: numbers of the estimate.
        control_dt: s.
        track: (N, 3 * frames) m, at least five frames: the ball's sensed positions, oldest first.
        turned: (N,) bool, the ball has been seen moving away.
        paddle_position, paddle_normal: (N, 3) m and unit vectors, from forward kinematics.
    """

    def __init__(
        self,
        config: ReturnMemoryConfig,
        control_dt: float,
        track: Tensor,
        turned: Tensor,
        paddle_position: Tensor,
        paddle_normal: Tensor,
    ) -> None:
        count, device = turned.shape[0], turned.device
        self.state = torch.zeros(count, MEMORY_SIZE, device=device)
        self.seen = self.state[:, -SEEN:]
        arrays = [wp.from_torch(track), share(turned), share(paddle_position), share(paddle_normal)]
        inputs = [*arrays, memory_rules(config, control_dt), wp.from_torch(self.state)]
        self._update: Callable[[], None] = record(remember_return, count, inputs, device)

    def update(self) -> None:
        """One control step later: ball, paddle and whether the ball has turned are new."""
        self._update()

    def restart(self, mask: Tensor) -> None:
        """Forget everything in the worlds of ``mask`` (N,) bool."""
        self.state.masked_fill_(mask.unsqueeze(-1), 0.0)


def memory_rules(config: ReturnMemoryConfig, control_dt: float) -> MemoryRules:
    """The numbers in the kernel's form."""
    rules = MemoryRules()
    rules.control_dt = control_dt
    rules.prior, rules.prior_hits, rules.hits = config.prior, config.prior_hits, config.hits
    rules.reach, rules.closing_speed, rules.largest = config.reach, config.closing_speed, config.largest
    return rules
