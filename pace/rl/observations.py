"""Observations of actor and critic: two tables from name to (size, function), and their histories.

The functions of :data:`POLICY` take :class:`ActorSignals`, which holds nothing but sensed signals and what the robot
can compute from them; those of :data:`CRITIC` take :class:`CriticSignals`, the true state. So the actor cannot see
the truth by accident: a privileged name in the policy's list is a configuration error.

A group's observation (N, H * D) is its last H frames of D numbers, oldest first. At reset of a world all H frames are
the current one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import accumulate
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from pace.config import ConfigError, PredictorConfig, RewardConfig
from pace.predictor.network import OUTPUT_SIZES
from pace.rl.state import TaskState
from pace.rl.task import clamp_x, nothing_to_hit
from pace.sim.sensing import Sensing, base_orientation

JOINTS = 21
#: Times further ahead than this are as good as none, s.
LONGEST_TIME = 2.0


class PaddlePose(Protocol):
    """Forward kinematics (:class:`pace.sim.kinematics.Kinematics`)."""

    def paddle_pose(self, base_position: Tensor, base_quat: Tensor, joint_position: Tensor) -> tuple[Tensor, Tensor]:
        """Centre (N, 3) m and unit normal (N, 3) of the paddle, world frame."""
        ...


Predictor = Callable[[Tensor], Tensor]


class BallTrack:
    """The last sensed positions of the current ball, and what they say about it.

    Attributes: ``positions`` (N, 3 * frames) m, oldest first, the predictor's input (before a ball has been seen that
    often, its first position is repeated); ``turned`` (N,) bool, the ball has been seen moving away since it was
    launched; ``something_to_hit`` (N,) bool, as far as the robot can know.
    """

    def __init__(self, frames: int, rule: Mapping[str, float], num_worlds: int, device: torch.device) -> None:
        if frames < 3:
            raise ConfigError(f"predictor.frames must be at least 3, got {frames}: the ball's velocity is seen over 3")
        self._rule = rule
        self.positions = torch.zeros(num_worlds, 3 * frames, device=device)
        self.turned = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self.something_to_hit = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self._frames = frames

    def update(self, sensed: Tensor, new_ball: Tensor) -> None:
        """One control step later: ``sensed`` (N, 3) m; ``new_ball`` (N,) bool marks balls just launched."""
        moved = torch.cat((self.positions[:, 3:], sensed), dim=1)
        self._set(torch.where(new_ball.unsqueeze(-1), sensed.repeat(1, self._frames), moved), new_ball)

    def restart(self, mask: Tensor, sensed: Tensor) -> None:
        """A new ball at ``sensed`` (N, 3) in the worlds of ``mask`` (N,) bool; the others stay as they are."""
        first = sensed.repeat(1, self._frames)
        self._set(torch.where(mask.unsqueeze(-1), first, self.positions), mask)

    def _set(self, positions: Tensor, new_ball: Tensor) -> None:
        self.positions.copy_(positions)
        change = positions[:, -3:] - positions[:, -9:-6]  # over two steps: noise matters less; only its sign is used
        self.turned.copy_((self.turned & ~new_ball) | (change[:, 0] > 0.0))
        closed = nothing_to_hit(positions[:, -3:], change, self._rule)
        torch.logical_not(closed | self.turned, out=self.something_to_hit)


class ActorSignals:
    """All that the actor may see, from :class:`Sensing`, its own actions, forward kinematics and the learned predictor.

    While there is nothing to hit the prediction is replaced by the point to stand by. Without a predictor (ablation)
    the predicted quantities are zero.

    Attributes, besides ``sensing`` and ``track``: ``action`` (N, J) the previous action, ``apex``, ``target``
    (N, 3) m predicted, ``time`` (N,) s until the ball is at the target, ``shift`` (N, 2) m from the sensed base to
    where it should stand, ``paddle_position`` (N, 3) m, ``paddle_normal`` (N, 3), ``prediction`` (N, P) raw output.
    """

    def __init__(
        self,
        sensing: Sensing,
        kinematics: PaddlePose,
        nominal: Tensor,
        predictor: Predictor | None,
        reward: RewardConfig,
        config: PredictorConfig,
        idle_point: Tensor,
    ) -> None:
        num_worlds, device = sensing.base_position.shape[0], sensing.base_position.device
        self.sensing = sensing
        self.track = BallTrack(config.frames, reward.nothing_to_hit, num_worlds, device)
        self._kinematics, self._nominal, self._idle_point = kinematics, nominal, idle_point
        self.predictor = predictor if config.enabled else None
        self._slices = predictor_slices(config.outputs)
        self._target_x, self._intercept = reward.target_x, reward.target_mode == "intercept"
        self._arm_offset = torch.tensor(reward.arm_offset, device=device)
        self._idle_base = torch.tensor(reward.idle_base_xy, device=device)
        self.action = torch.zeros(num_worlds, nominal.shape[0], device=device)
        self.prediction = torch.zeros(num_worlds, sum(OUTPUT_SIZES[name] for name in config.outputs), device=device)
        self.apex, self.target = torch.zeros(num_worlds, 3, device=device), torch.zeros(num_worlds, 3, device=device)
        self.time = torch.zeros(num_worlds, device=device)
        self.shift = torch.zeros(num_worlds, 2, device=device)
        self.paddle_position = torch.zeros(num_worlds, 3, device=device)
        self.paddle_normal = torch.zeros(num_worlds, 3, device=device)

    def compute(self) -> None:
        """Everything that follows from the current ``sensing``, ``track`` and ``action``."""
        sensing = self.sensing
        orientation = base_orientation(sensing.projected_gravity, sensing.heading)
        joints = sensing.joint_position + self._nominal
        centre, normal = self._kinematics.paddle_pose(sensing.base_position, orientation, joints)
        self.paddle_position.copy_(centre)
        self.paddle_normal.copy_(normal)
        if self.predictor is not None:
            self._predict(self.predictor)

    def _predict(self, predictor: Predictor) -> None:
        with torch.no_grad(), torch.autocast(self.prediction.device.type, enabled=False):
            self.prediction.copy_(predictor(self.track.positions))
        active = self.track.something_to_hit
        wide = active.unsqueeze(-1)
        apex = self.prediction[:, self._slices["apex"]]
        own = "target" in self._slices
        target = self.prediction[:, self._slices["target"]] if own else clamp_x(apex, self._target_x)
        self.apex.copy_(torch.where(wide, apex, self._idle_point))
        self.target.copy_(torch.where(wide, target, self._idle_point))
        if "target_time" in self._slices:
            time = self.prediction[:, self._slices["target_time"].start].clamp(0.0, LONGEST_TIME)
            torch.mul(time, active, out=self.time)
        goal = (target if self._intercept else apex)[:, :2] + self._arm_offset
        goal = torch.where(wide, goal, self._idle_base)
        torch.sub(goal, self.sensing.base_position[:, :2], out=self.shift)
        self.shift.add_(self.sensing.base_shift_noise)


def predictor_slices(outputs: list[str]) -> dict[str, slice]:
    """Columns of each named part of the predictor's output.

    Errors: :class:`ConfigError` for an unknown name, or when the apex is not among them.
    """
    unknown = [name for name in outputs if name not in OUTPUT_SIZES]
    if unknown or "apex" not in outputs:
        raise ConfigError(f"predictor.outputs must hold apex and may hold {list(OUTPUT_SIZES)}: {outputs}")
    ends = list(accumulate(OUTPUT_SIZES[name] for name in outputs))
    return {name: slice(end - OUTPUT_SIZES[name], end) for name, end in zip(outputs, ends, strict=True)}


class CriticSignals:
    """All that the critic sees: the true state, and the forecast where there is something to hit.

    Attributes: ``state``; ``apex``, ``target`` (N, 3) m, idle where there is nothing to hit; ``time`` (N,) s until the
    ball is at the target, ``shift`` (N, 2) m.
    """

    def __init__(self, state: TaskState, reward: RewardConfig) -> None:
        self.state = state
        self._intercept = reward.target_mode == "intercept"
        device = state.action.device
        self._arm_offset = torch.tensor(reward.arm_offset, device=device)
        self._idle_base = torch.tensor(reward.idle_base_xy, device=device)
        self.apex, self.target = torch.zeros_like(state.game.target.apex), torch.zeros_like(state.game.target.apex)
        self.time = torch.zeros_like(state.game.target.time)
        self.shift = torch.zeros_like(state.base_error)

    def compute(self) -> None:
        """Everything that follows from the current state."""
        state, target = self.state, self.state.game.target
        wide = state.something_to_hit.unsqueeze(-1)
        self.apex.copy_(torch.where(wide, target.apex, target.idle_point))
        self.target.copy_(torch.where(wide, target.point, target.idle_point))
        left = (target.time - state.game.clock.time).clamp_(0.0, LONGEST_TIME)
        torch.mul(left, state.something_to_hit, out=self.time)
        if self._intercept:
            self.shift.copy_(state.base_error)
            return
        goal = torch.where(wide, self.apex[:, :2] + self._arm_offset, self._idle_base)
        torch.sub(goal, state.robot.base_position[:, :2], out=self.shift)


class ActorObservation(NamedTuple):
    """Size and function of one observation of the actor."""

    size: int
    function: Callable[[ActorSignals], Tensor]


class CriticObservation(NamedTuple):
    """Size and function of one observation of the critic."""

    size: int
    function: Callable[[CriticSignals], Tensor]


def _column(values: Tensor) -> Tensor:
    return values.unsqueeze(-1).float()


#: What the actor can see: sensed, delayed, noisy signals, and what is computed from them.
POLICY: dict[str, ActorObservation] = {
    "base_angular_velocity": ActorObservation(3, lambda s: s.sensing.base_angular_velocity),
    "base_position": ActorObservation(3, lambda s: s.sensing.base_position),
    "projected_gravity": ActorObservation(3, lambda s: s.sensing.projected_gravity),
    "joint_position": ActorObservation(JOINTS, lambda s: s.sensing.joint_position),
    "joint_velocity": ActorObservation(JOINTS, lambda s: s.sensing.joint_velocity),
    "previous_action": ActorObservation(JOINTS, lambda s: s.action),
    "ball_position": ActorObservation(3, lambda s: s.sensing.ball_position),
    "heading": ActorObservation(2, lambda s: s.sensing.heading),
    "predicted_apex": ActorObservation(3, lambda s: s.apex),
    "predicted_base_shift": ActorObservation(2, lambda s: s.shift),
    "sensed_paddle_to_target": ActorObservation(3, lambda s: s.target - s.paddle_position),
    "sensed_paddle_normal": ActorObservation(3, lambda s: s.paddle_normal),
    "predicted_time": ActorObservation(1, lambda s: _column(s.time)),
    "something_to_hit": ActorObservation(1, lambda s: _column(s.track.something_to_hit)),
}

#: What the critic can see: the truth.
CRITIC: dict[str, CriticObservation] = {
    "base_angular_velocity": CriticObservation(3, lambda s: s.state.robot.base_angular_velocity),
    "base_position": CriticObservation(3, lambda s: s.state.robot.base_position),
    "projected_gravity": CriticObservation(3, lambda s: s.state.robot.projected_gravity),
    "joint_position": CriticObservation(JOINTS, lambda s: s.state.robot.joint_position - s.state.nominal),
    "joint_velocity": CriticObservation(JOINTS, lambda s: s.state.robot.joint_velocity),
    "previous_action": CriticObservation(JOINTS, lambda s: s.state.action),
    "ball_position": CriticObservation(3, lambda s: s.state.ball.position),
    "heading": CriticObservation(2, lambda s: s.state.robot.heading),
    "apex": CriticObservation(3, lambda s: s.apex),
    "base_shift": CriticObservation(2, lambda s: s.shift),
    "ball_velocity": CriticObservation(3, lambda s: s.state.ball.velocity),
    "paddle_position": CriticObservation(3, lambda s: s.state.robot.paddle_position),
    "time_to_arrival": CriticObservation(1, lambda s: _column(s.time)),
    "serve_progress": CriticObservation(1, lambda s: _column(s.state.game.clock.serve_progress)),
    "episode_progress": CriticObservation(1, lambda s: _column(s.state.game.clock.episode_progress)),
    "own_bounce": CriticObservation(1, lambda s: _column(s.state.game.referee.own_bounces > 0)),
    "paddle_touched": CriticObservation(1, lambda s: _column(s.state.game.referee.touched)),
    "base_linear_velocity": CriticObservation(3, lambda s: s.state.robot.base_linear_velocity),
    "foot_contact": CriticObservation(2, lambda s: s.state.foot_contact.float()),
    "paddle_to_target": CriticObservation(3, lambda s: s.target - s.state.robot.paddle_position),
    "paddle_velocity": CriticObservation(3, lambda s: s.state.robot.paddle_velocity),
    "paddle_normal": CriticObservation(3, lambda s: s.state.robot.paddle_normal),
}

Table = Mapping[str, ActorObservation] | Mapping[str, CriticObservation]


def check_policy(names: list[str], predictor: PredictorConfig) -> None:
    """Raise :class:`ConfigError` for a name that the actor may not see, or that nobody computes."""
    _check_names("policy", names, POLICY)
    if "predicted_time" in names and predictor.enabled and "target_time" not in predictor.outputs:
        raise ConfigError("observation.policy has 'predicted_time': add 'target_time' to predictor.outputs")


def check_critic(names: list[str]) -> None:
    """Raise :class:`ConfigError` for an unknown name."""
    _check_names("critic", names, CRITIC)


def _check_names(group: str, names: list[str], table: Table) -> None:
    for name in names:
        if name not in table:
            hint = " (privileged: for the critic alone)" if name in CRITIC else ""
            raise ConfigError(f"observation.{group}: unknown name '{name}'{hint}; known: {', '.join(table)}")


def layout(names: list[str], table: Table) -> dict[str, slice]:
    """Columns of each observation within a frame."""
    columns, start = {}, 0
    for name in names:
        columns[name] = slice(start, start + table[name].size)
        start += table[name].size
    return columns


class History:
    """The last H frames of N worlds.

    Attributes: ``frame`` (N, D) the newest, ``observation`` (N, H * D) all of them, oldest first, ``frames``
    (N, H, D) the same.
    """

    def __init__(self, frames: int, size: int, num_worlds: int, device: torch.device) -> None:
        self.frame = torch.zeros(num_worlds, size, device=device)
        self.observation = torch.zeros(num_worlds, frames * size, device=device)
        self.frames = self.observation.view(num_worlds, frames, size)

    def push(self, signals: list[Tensor]) -> None:
        """Append a frame made of ``signals``, each (N, size)."""
        torch.cat(signals, dim=1, out=self.frame)
        for older in range(self.frames.shape[1] - 1):
            self.frames[:, older].copy_(self.frames[:, older + 1])
        self.frames[:, -1].copy_(self.frame)

    def fill(self, mask: Tensor, signals: list[Tensor]) -> None:
        """Set all frames of the worlds of ``mask`` (N,) bool to the current one."""
        torch.cat(signals, dim=1, out=self.frame)
        wide = mask.view(-1, 1, 1)
        torch.where(wide, self.frame.unsqueeze(1), self.frames, out=self.frames)
