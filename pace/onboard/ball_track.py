"""The last sensed positions of the current ball, and two flags derived from them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from pace.config.base import ConfigError
from pace.config.task import TaskConfig
from pace.sim.ball.aero import GRAVITY

NET_X = 0.0  # m, world frame


class Track(NamedTuple):
    """The track of a robot's ball.

    ``positions`` (N, 3 * frames) m, oldest first, the predictor's input (until a ball has been sensed that often, its
    first position is repeated); ``turned`` (N,) bool, this ball was sensed moving away;
    ``something_to_hit`` (N,) bool, estimated from the sensed positions; ``age`` (N,) s since the newest frame was
    captured.
    """

    positions: Tensor
    turned: Tensor
    something_to_hit: Tensor
    age: Tensor


class BallTrack(nn.Module):
    """Tracks each robot's ball, and finds from its sensed positions alone that another ball is in play.

    Three things begin a new track. A jump: the ball is sensed farther from its last position than a ball flies between
    the two frames. A reversal: a ball that moved away comes towards the robot again beyond the net, where only another
    player or a serving machine sends it back. A gap: no frame showed the ball for longer than ``sensing.longest_gap``.

    Positions are one control step apart. If no frame arrived in a step, its position is extrapolated from the last two,
    in free fall; once the newest frame is older than ``sensing.longest_gap``, the ball stays where it is.

    Args: config: ``predictor.frames``, ``sensing.moved``, ``sensing.fastest_ball``, ``sensing.longest_gap``,
    ``robot.control_dt`` and ``reward.nothing_to_hit``.
    Errors: :class:`ConfigError` for fewer than three frames.
    """

    fall: Tensor

    def __init__(self, config: TaskConfig) -> None:
        super().__init__()
        self.frames, self.moved = config.predictor.frames, config.sensing.moved
        if self.frames < 3:
            raise ConfigError(
                f"predictor.frames must be at least 3, got {self.frames}: the ball's velocity is seen over 3"
            )
        self.fastest_ball, self.longest_gap = config.sensing.fastest_ball, config.sensing.longest_gap
        self.control_dt = config.robot.control_dt
        # m in a control step; a buffer, since a captured step brings nothing to the device
        fall = torch.tensor([0.0, 0.0, GRAVITY * self.control_dt**2])
        self.register_buffer("fall", fall, persistent=False)
        rule = config.reward.nothing_to_hit
        self.past_x, self.low_z, self.falling_x = rule["past_x"], rule["low_z"], rule["falling_x"]

    def begin(self, sensed: Tensor, age: Tensor) -> Track:
        """The track of a new ball that is first sensed at (N, 3) m, in a frame of this age (N,) s."""
        positions = sensed.repeat(1, self.frames)
        return self._judge(positions, torch.zeros_like(sensed[:, 0], dtype=torch.bool), age)

    def forward(
        self, track: Track, sensed: Tensor, age: Tensor, arrived: Tensor, started: Tensor | None = None
    ) -> Track:
        """The track after one more control step.

        Args: track of the step before; sensed (N, 3) m, of a frame of this age (N,) s; arrived (N,) bool: that frame
        arrived in this step; started (N,) bool: the other robots begin as in :meth:`begin`; ``None``: all have started.
        """
        new_ball = arrived & self.new_ball(track, sensed, age)
        new_ball = new_ball if started is None else new_ball | ~started
        known = arrived | new_ball
        position = torch.where(known.unsqueeze(1), sensed, self._extrapolate(track.positions, age))
        return self._judge(self.append(track.positions, position, new_ball), track.turned & ~new_ball, age)

    def new_ball(self, track: Track, sensed: Tensor, age: Tensor) -> Tensor:
        """(N,) bool: the ball sensed at (N, 3) m, in a new frame of this age (N,) s, is not the one that was tracked,
        or was sent again."""
        between = (track.age + self.control_dt - age).clamp(min=self.control_dt)  # s
        jumped = (sensed - track.positions[:, -3:]).square().sum(1) > (self.fastest_ball * between).square()
        towards = track.positions[:, -6] - sensed[:, 0] > self.moved  # over two steps
        unseen = between > self.longest_gap + self.control_dt
        return jumped | unseen | (track.turned & towards & (sensed[:, 0] > NET_X))

    def _extrapolate(self, positions: Tensor, age: Tensor) -> Tensor:
        """(N, 3) m: the ball one control step after the last of its positions."""
        last = positions[:, -3:]
        step = last - positions[:, -6:-3] - self.fall
        return torch.where((age < self.longest_gap).unsqueeze(1), last + step, last)

    def append(self, positions: Tensor, sensed: Tensor, new_ball: Tensor) -> Tensor:
        """The positions (N, 3 * frames) m alone, after one more control step; those of ``new_ball`` (N,) restart."""
        longer = torch.cat((positions[:, 3:], sensed), dim=1)
        return torch.where(new_ball.unsqueeze(1), sensed.repeat(1, self.frames), longer)

    def _judge(self, positions: Tensor, turned: Tensor, age: Tensor) -> Track:
        # over two steps, to reduce the effect of noise. A ball sensed with delay stands still at first, up to noise
        change = positions[:, -3:] - positions[:, -9:-6]
        gone = (change[:, 0] > self.moved) | turned
        return Track(positions, gone, ~(gone | self._nothing_to_hit(positions[:, -3:], change)), age)

    def _nothing_to_hit(self, position: Tensor, change: Tensor) -> Tensor:
        """As in the referee (:func:`pace.task.rules.nothing_to_hit`): past the robot, too low, falling."""
        x, z = position[:, 0], position[:, 2]
        return (x < self.past_x) | (z < self.low_z) | ((x < self.falling_x) & (change[:, 2] < 0.0))
