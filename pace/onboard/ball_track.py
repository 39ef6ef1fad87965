"""The last sensed positions of the current ball, and two flags derived from them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from pace.config.base import ConfigError
from pace.config.task import TaskConfig

NET_X = 0.0  # m, world frame


class Track(NamedTuple):
    """The track of a robot's ball.

    ``positions`` (N, 3 * frames) m, oldest first, the predictor's input (until a ball has been sensed that often, its
    first position is repeated); ``turned`` (N,) bool, this ball was sensed moving away;
    ``something_to_hit`` (N,) bool, estimated from the sensed positions.
    """

    positions: Tensor
    turned: Tensor
    something_to_hit: Tensor


class BallTrack(nn.Module):
    """Tracks each robot's ball, and finds from its sensed positions alone that another ball is in play.

    Two things begin a new track. A jump: the ball is sensed farther from its last position than a ball flies in a
    control step. A reversal: a ball that moved away comes towards the robot again beyond the net, where only another
    player or a serving machine sends it back.

    Args: config: ``predictor.frames``, ``sensing.moved``, ``sensing.fastest_ball``, ``robot.control_dt`` and
    ``reward.nothing_to_hit``.
    Errors: :class:`ConfigError` for fewer than three frames.
    """

    def __init__(self, config: TaskConfig) -> None:
        super().__init__()
        self.frames, self.moved = config.predictor.frames, config.sensing.moved
        if self.frames < 3:
            raise ConfigError(
                f"predictor.frames must be at least 3, got {self.frames}: the ball's velocity is seen over 3"
            )
        self.jump = config.sensing.fastest_ball * config.robot.control_dt  # m
        rule = config.reward.nothing_to_hit
        self.past_x, self.low_z, self.falling_x = rule["past_x"], rule["low_z"], rule["falling_x"]

    def begin(self, sensed: Tensor) -> Track:
        """The track of a new ball that is first sensed at (N, 3) m."""
        positions = sensed.repeat(1, self.frames)
        return self._judge(positions, torch.zeros_like(sensed[:, 0], dtype=torch.bool))

    def forward(self, positions: Tensor, turned: Tensor, sensed: Tensor, started: Tensor | None = None) -> Track:
        """The track after one more control step.

        Args: positions (N, 3 * frames) m and turned (N,) bool of the step before; sensed (N, 3) m; started (N,) bool:
        the other robots begin as in :meth:`begin`; ``None``: all have started.
        """
        new_ball = self.new_ball(positions, turned, sensed)
        new_ball = new_ball if started is None else new_ball | ~started
        return self._judge(self.append(positions, sensed, new_ball), turned & ~new_ball)

    def new_ball(self, positions: Tensor, turned: Tensor, sensed: Tensor) -> Tensor:
        """(N,) bool: the ball that is now sensed at (N, 3) m is not the one that was tracked, or was sent again."""
        jumped = (sensed - positions[:, -3:]).square().sum(1) > self.jump**2
        towards = positions[:, -6] - sensed[:, 0] > self.moved  # over two steps
        return jumped | (turned & towards & (sensed[:, 0] > NET_X))

    def append(self, positions: Tensor, sensed: Tensor, new_ball: Tensor) -> Tensor:
        """The positions (N, 3 * frames) m alone, after one more control step; those of ``new_ball`` (N,) restart."""
        longer = torch.cat((positions[:, 3:], sensed), dim=1)
        return torch.where(new_ball.unsqueeze(1), sensed.repeat(1, self.frames), longer)

    def _judge(self, positions: Tensor, turned: Tensor) -> Track:
        # over two steps, to reduce the effect of noise. A ball sensed with delay stands still at first, up to noise
        change = positions[:, -3:] - positions[:, -9:-6]
        gone = (change[:, 0] > self.moved) | turned
        return Track(positions, gone, ~(gone | self._nothing_to_hit(positions[:, -3:], change)))

    def _nothing_to_hit(self, position: Tensor, change: Tensor) -> Tensor:
        """As in the referee (:func:`pace.task.rules.nothing_to_hit`): past the robot, too low, falling."""
        x, z = position[:, 0], position[:, 2]
        return (x < self.past_x) | (z < self.low_z) | ((x < self.falling_x) & (change[:, 2] < 0.0))
