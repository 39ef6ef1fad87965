"""Observations of actor and critic: two tables from name to (size, function), and their histories.

The functions of :data:`POLICY` take :class:`ActorSignals`, which holds nothing but sensed signals and what the robot
can compute from them; those of :data:`CRITIC` take :class:`TaskState`, the truth. So the actor cannot see the
truth by accident: a privileged name in the policy's list is a configuration error.

Both tables take observations from outside (:mod:`pace.config.plugins`): in the list of names, an entry point or the
import path of an :class:`ActorObservation` or :class:`CriticObservation`. The type tells for whom it is.

A group's observation (N, H * D) is its last H frames of D numbers, oldest first. At reset of a world all H frames are
the current one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol, TypeVar

import torch
import warp as wp
from torch import Tensor

from pace.arrays.share import record, share
from pace.config.base import ConfigError
from pace.config.plugins import CRITIC_OBSERVATIONS, OBSERVATIONS, Registry
from pace.config.task import OBSERVED_FROM, ObservationConfig, PredictorConfig, ReturnMemoryConfig
from pace.onboard.attitude import AttitudeEstimate
from pace.onboard.delay import DelayEstimate
from pace.onboard.joints import JointEstimate
from pace.onboard.kernels import PredictionLayout, SignalArrays, fill_frames, follow_ball, read_prediction
from pace.onboard.returns import SEEN, ReturnMemory
from pace.predictor.network import OUTPUT_SIZES, predictor_slices
from pace.sim.sensing import Sensing
from pace.task.game_kernels import Rules
from pace.task.state import TaskState

JOINTS = 21


class PaddlePose(Protocol):
    """Forward kinematics (:class:`pace.sim.kinematics.Kinematics`)."""

    def paddle_pose(
        self, base_position: Tensor, base_quat: Tensor, joint_position: Tensor, mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Centre (N, 3) m and unit normal (N, 3) of the paddle, world frame; ``mask``: the worlds that are new."""
        ...


Predictor = Callable[[Tensor], Tensor]


class BallTrack:
    """The last sensed positions of the current ball, and what they say about it.

    Attributes: ``positions`` (N, 3 * frames) m, oldest first, the predictor's input (before a ball has been seen that
    often, its first position is repeated); ``turned`` (N,) bool, the ball has been seen moving away since it was
    launched; ``something_to_hit`` (N,) bool, as far as the robot can know.
    """

    def __init__(self, frames: int, rules: Rules, num_worlds: int, device: torch.device) -> None:
        if frames < 3:
            raise ConfigError(f"predictor.frames must be at least 3, got {frames}: the ball's velocity is seen over 3")
        self._rules = rules
        self.positions = torch.zeros(num_worlds, 3 * frames, device=device)
        self.turned = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self.something_to_hit = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self._mask = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self._sensed: Tensor | None = None

    def update(self, sensed: Tensor, new_ball: Tensor) -> None:
        """One control step later: ``sensed`` (N, 3) m; ``new_ball`` (N,) bool marks balls just launched."""
        self._prepare(sensed, new_ball)
        self._update()

    def restart(self, mask: Tensor, sensed: Tensor) -> None:
        """A new ball at ``sensed`` (N, 3) in the worlds of ``mask`` (N,) bool; the others stay as they are."""
        self._prepare(sensed, mask)
        self._restart()

    def _prepare(self, sensed: Tensor, mask: Tensor) -> None:
        self._mask.copy_(mask)
        if sensed is not self._sensed:
            self._bind(sensed)

    def _bind(self, sensed: Tensor) -> None:
        self._sensed = sensed
        count, device = self.positions.shape[0], self.positions.device
        own = [wp.from_torch(tensor) for tensor in (self.positions, self.turned, self.something_to_hit)]
        shared = [share(sensed), *own, self._rules]
        self._update = record(follow_ball, count, [share(self._mask), 1, *shared], device)
        self._restart = record(follow_ball, count, [share(self._mask), 0, *shared], device)


class ActorSignals:
    """All that the actor may see, from :class:`Sensing`, its own actions, forward kinematics and the learned predictor.

    While there is nothing to hit the prediction is replaced by the point to stand by. Without a predictor (ablation)
    the predicted quantities are zero.

    Attributes, besides ``sensing`` and ``track``: ``action`` (N, J) the previous action, ``apex``, ``target``
    (N, 3) m predicted, ``time`` (N,) s until the ball is at the target, ``shift`` (N, 2) m from the sensed base to
    where it should stand, ``paddle_position`` (N, 3) m, ``paddle_normal`` (N, 3), ``prediction`` (N, P) raw output;
    ``memory`` of its returns and ``delay`` of its motion capture, or ``None``: see :meth:`remember`; ``attitude`` and
    ``joints``, the estimates that the paddle's pose is computed with, or ``None``: what is sensed.

    Args:
        sensing: the robot's sensors.
        kinematics: forward kinematics of the paddle.
        nominal: (J,) rad.
        action: (N, J) the robot's own last action, kept up to date by its owner.
        predictor: callable (N, 3 * frames) -> (N, P), or ``None``.
        config: which outputs the predictor has, and whether it is used.
        rules: where to stand and what can be hit, in the kernels' form.
        observation: numbers of what is remembered over an episode, where the policy observes it.
    """

    def __init__(
        self,
        sensing: Sensing,
        kinematics: PaddlePose,
        nominal: Tensor,
        action: Tensor,
        predictor: Predictor | None,
        config: PredictorConfig,
        rules: Rules,
        observation: ObservationConfig | None = None,
    ) -> None:
        num_worlds, device = action.shape[0], action.device
        self.sensing, self.action = sensing, action
        self.track = BallTrack(config.frames, rules, num_worlds, device)
        self.predictor = predictor if config.enabled else None
        self._kinematics, self._nominal = kinematics, nominal
        self._joints = torch.zeros_like(action)
        self.prediction = torch.zeros(num_worlds, sum(OUTPUT_SIZES[name] for name in config.outputs), device=device)
        self.apex, self.target = torch.zeros(num_worlds, 3, device=device), torch.zeros(num_worlds, 3, device=device)
        self.time = torch.zeros(num_worlds, device=device)
        self.shift = torch.zeros(num_worlds, 2, device=device)
        self.paddle_position = torch.zeros(num_worlds, 3, device=device)
        self.paddle_normal = torch.zeros(num_worlds, 3, device=device)
        self._read = self._record(predictor_slices(config.outputs), rules)
        memory, delay = (observation.memory, observation.delay) if observation else (None, None)
        self.memory = self._make_memory(memory, rules.control_dt) if memory else None
        self.delay = DelayEstimate(delay, rules.control_dt, sensing) if delay else None
        attitude = observation.attitude if observation else None
        self.attitude = AttitudeEstimate(attitude, rules.control_dt, sensing) if attitude else None
        self._base_quat = self.attitude.quat if self.attitude else sensing.base_quat
        joints = observation.joints if observation else None
        self.joints = JointEstimate(joints, rules.control_dt, sensing) if joints else None
        self._joint_offset = self.joints.position if self.joints else sensing.joint_position

    def _record(self, slices: dict[str, slice], rules: Rules) -> Callable[[], None]:
        columns = PredictionLayout()
        columns.apex, columns.target, columns.time = (
            slices[name].start if name in slices else -1 for name in ("apex", "target", "target_time")
        )
        noise = wp.from_torch(self.sensing.base_shift_noise, dtype=wp.vec2)
        seen = [share(self.track.something_to_hit), share(self.sensing.base_position), noise]
        shift = wp.from_torch(self.shift, dtype=wp.vec2)
        results = [share(self.apex), share(self.target), share(self.time), shift]
        inputs = [wp.from_torch(self.prediction), columns, *seen, rules, *results]
        return record(read_prediction, self.action.shape[0], inputs, self.action.device)

    def _make_memory(self, config: ReturnMemoryConfig, control_dt: float) -> ReturnMemory:
        track = self.track
        return ReturnMemory(config, control_dt, track.positions, track.turned, self.paddle_position, self.paddle_normal)

    def remember(self) -> None:
        """One control step later, after :meth:`compute`: what is kept over an episode."""
        for kept in (self.memory, self.delay):
            if kept is not None:
                kept.update()

    def forget(self, mask: Tensor) -> None:
        """New episodes, in the worlds of ``mask`` (N,) bool, after :meth:`compute`."""
        for kept in (self.memory, self.delay):
            if kept is not None:
                kept.restart(mask)

    def compute(self, changed: Tensor | None = None) -> None:
        """Everything that follows from the current ``sensing``, ``track`` and ``action``: once a control step.

        ``changed`` (N,) bool: the worlds in which an episode begins; the others stay. ``None``: all go on.
        """
        sensing = self.sensing
        for estimate in (self.attitude, self.joints):
            if estimate is not None:
                estimate.update() if changed is None else estimate.restart(changed)
        torch.add(self._joint_offset, self._nominal, out=self._joints)
        centre, normal = self._kinematics.paddle_pose(sensing.base_position, self._base_quat, self._joints, changed)
        self.paddle_position.copy_(centre)
        self.paddle_normal.copy_(normal)
        if self.predictor is not None:
            with torch.no_grad(), torch.autocast(self.prediction.device.type, enabled=False):
                self._predict(self.predictor, changed)
            self._read()

    def _predict(self, predictor: Predictor, changed: Tensor | None) -> None:
        if changed is not None and changed.device.type == "cpu":  # looking costs no wait there, and few are new
            rows = changed.nonzero().squeeze(1)
            self.prediction[rows] = predictor(self.track.positions[rows])
        else:
            self.prediction.copy_(predictor(self.track.positions))


class ActorObservation(NamedTuple):
    """Size and function of one observation of the actor."""

    size: int
    function: Callable[[ActorSignals], Tensor]


class CriticObservation(NamedTuple):
    """Size and function of one observation of the critic."""

    size: int
    function: Callable[[TaskState], Tensor]


def _last_return(signals: ActorSignals) -> Tensor:
    assert signals.memory is not None  # check_policy has seen to it
    return signals.memory.seen


def _sensed_delay(signals: ActorSignals) -> Tensor:
    assert signals.delay is not None  # check_policy has seen to it
    return signals.delay.seen


def _attitude(signals: ActorSignals) -> AttitudeEstimate:
    assert signals.attitude is not None  # check_policy has seen to it
    return signals.attitude


def _joints(signals: ActorSignals) -> JointEstimate:
    assert signals.joints is not None  # check_policy has seen to it
    return signals.joints


def _column(values: Tensor) -> Tensor:
    return values.unsqueeze(-1)


Observation = TypeVar("Observation", ActorObservation, CriticObservation)


def _only(kind: type[Observation]) -> Callable[[object], Observation]:
    def accept(found: object) -> Observation:
        if isinstance(found, kind):
            return found
        privileged = " (privileged: for the critic alone)" if isinstance(found, CriticObservation) else ""
        raise TypeError(f"must be of type {kind.__name__}, not {type(found).__name__}{privileged}")

    return accept


#: What the actor can see: sensed, delayed, noisy signals, and what is computed from them.
POLICY: Registry[ActorObservation] = Registry("name", OBSERVATIONS, _only(ActorObservation))
POLICY |= {
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
    "last_return": ActorObservation(SEEN, _last_return),
    "sensed_delay": ActorObservation(1, _sensed_delay),
    "estimated_gravity": ActorObservation(3, lambda s: _attitude(s).gravity),
    "estimated_heading": ActorObservation(2, lambda s: _attitude(s).heading),
    "estimated_joint_position": ActorObservation(JOINTS, lambda s: _joints(s).position),
    "estimated_joint_velocity": ActorObservation(JOINTS, lambda s: _joints(s).velocity),
}

#: What the critic can see: the truth.
CRITIC: Registry[CriticObservation] = Registry("name", CRITIC_OBSERVATIONS, _only(CriticObservation))
CRITIC |= {
    "base_angular_velocity": CriticObservation(3, lambda s: s.robot.base_angular_velocity),
    "base_position": CriticObservation(3, lambda s: s.robot.base_position),
    "projected_gravity": CriticObservation(3, lambda s: s.robot.projected_gravity),
    "joint_position": CriticObservation(JOINTS, lambda s: s.joint_offset),
    "joint_velocity": CriticObservation(JOINTS, lambda s: s.robot.joint_velocity),
    "previous_action": CriticObservation(JOINTS, lambda s: s.action),
    "ball_position": CriticObservation(3, lambda s: s.ball.position),
    "heading": CriticObservation(2, lambda s: s.robot.heading),
    "apex": CriticObservation(3, lambda s: s.apex),
    "base_shift": CriticObservation(2, lambda s: s.shift),
    "ball_velocity": CriticObservation(3, lambda s: s.ball.velocity),
    "paddle_position": CriticObservation(3, lambda s: s.robot.paddle_position),
    "time_to_arrival": CriticObservation(1, lambda s: _column(s.arrival)),
    "serve_progress": CriticObservation(1, lambda s: _column(s.serve_progress)),
    "episode_progress": CriticObservation(1, lambda s: _column(s.episode_progress)),
    "own_bounce": CriticObservation(1, lambda s: _column(s.game.referee.own_bounces > 0)),
    "paddle_touched": CriticObservation(1, lambda s: _column(s.game.referee.touched)),
    "base_linear_velocity": CriticObservation(3, lambda s: s.robot.base_linear_velocity),
    "foot_contact": CriticObservation(2, lambda s: s.foot_contact),
    "paddle_to_target": CriticObservation(3, lambda s: s.paddle_to_target),
    "paddle_velocity": CriticObservation(3, lambda s: s.robot.paddle_velocity),
    "paddle_normal": CriticObservation(3, lambda s: s.robot.paddle_normal),
    # of each world: the restitution is that at speed zero
    "paddle_restitution": CriticObservation(1, lambda s: _column(torch.as_tensor(s.ball.params.paddle_restitution))),
    "paddle_friction": CriticObservation(1, lambda s: _column(torch.as_tensor(s.ball.params.paddle_friction))),
    "mocap_delay": CriticObservation(1, lambda s: _column(s.mocap_delay)),
}

Table = Mapping[str, ActorObservation] | Mapping[str, CriticObservation]


def check_policy(observation: ObservationConfig, predictor: PredictorConfig) -> None:
    """Raise :class:`ConfigError` for a name that the actor may not see, or that nobody computes."""
    names = observation.policy
    _check_names("policy", names, POLICY)
    for needed in OBSERVED_FROM:
        asked = observation.observed_from(needed)
        if asked and getattr(observation, needed) is None:
            raise ConfigError(f"observation.policy has '{asked[0]}': give observation.{needed} (observation=memory)")
    if "last_return" in names and predictor.frames < 5:
        raise ConfigError(f"observation 'last_return' needs predictor.frames of 5 or more, got {predictor.frames}")
    if "predicted_time" in names and predictor.enabled and "target_time" not in predictor.outputs:
        raise ConfigError("observation.policy has 'predicted_time': add 'target_time' to predictor.outputs")


def check_critic(names: list[str]) -> None:
    """Raise :class:`ConfigError` for an unknown name."""
    _check_names("critic", names, CRITIC)


def _check_names(group: str, names: list[str], table: Table) -> None:
    for name in names:
        if name not in table and name in CRITIC:
            what = "privileged: for the critic alone"
            raise ConfigError(f"observation.{group}: unknown name '{name}' ({what}); known: {', '.join(table)}")
        try:
            table[name]
        except ConfigError as error:
            raise ConfigError(f"observation.{group}: {error}") from error


def layout(names: list[str], table: Table) -> dict[str, slice]:
    """Columns of each observation within a frame."""
    columns, start = {}, 0
    for name in names:
        columns[name] = slice(start, start + table[name].size)
        start += table[name].size
    return columns


class Signals:
    """Observations that are side by side in a frame.

    A signal that lies where it lay before is read there; another one, which its function computes, is kept in a tensor
    of its own. Which of them it is, is seen at the start, so a function must do the same each time.

    Attributes: ``tensors``, (N, size) float32 each, with the values of the last :meth:`compute`.

    Args: functions: each returns a signal (N, size), float32 or bool.
    """

    def __init__(self, functions: Sequence[Callable[[], Tensor]]) -> None:
        self.tensors: list[Tensor] = []
        self._computed: list[tuple[Callable[[], Tensor], Tensor]] = []
        for function in functions:
            signal, again = function(), function()  # both at once, or the second could lie where the first was
            if signal.data_ptr() != again.data_ptr() or signal.dtype != torch.float32:
                signal = signal.float()
                self._computed.append((function, signal))
            self.tensors.append(signal)

    def compute(self) -> None:
        """Bring all of them up to date."""
        for function, signal in self._computed:
            signal.copy_(function())

    def arrays(self) -> wp.array:
        """Where they are, for kernels."""
        arrays, start = [], 0
        for tensor in self.tensors:
            signal = SignalArrays()
            signal.values, signal.start = wp.from_torch(tensor), start
            arrays.append(signal)
            start += tensor.shape[1]
        return wp.array(arrays, dtype=SignalArrays, device=wp.device_from_torch(self.tensors[0].device))


class History:
    """The last H frames of N worlds.

    Attributes: ``frame`` (N, D) the newest, ``observation`` (N, H * D) all of them, oldest first, ``frames``
    (N, H, D) the same.

    Args: frames: H; functions: of the signals that make a frame, as :class:`Signals` wants them.
    """

    def __init__(self, frames: int, functions: Sequence[Callable[[], Tensor]]) -> None:
        self._signals = Signals(functions)
        tensors = self._signals.tensors
        size, count, device = sum(tensor.shape[1] for tensor in tensors), len(tensors[0]), tensors[0].device
        self.frame = torch.zeros(count, size, device=device)
        self.observation = torch.zeros(count, frames * size, device=device)
        self.frames = self.observation.view(count, frames, size)
        self._mask = torch.zeros(count, dtype=torch.bool, device=device)
        own = [wp.from_torch(tensor) for tensor in (self.frame, self.observation)]
        self._fill = record(fill_frames, count, [share(self._mask), self._signals.arrays(), *own], device)

    def push(self) -> None:
        """Append a frame made of the present signals."""
        self._signals.compute()
        torch.cat(self._signals.tensors, dim=1, out=self.frame)
        for older in range(self.frames.shape[1] - 1):  # twice as fast as a kernel, which Warp does not vectorise
            self.frames[:, older].copy_(self.frames[:, older + 1])
        self.frames[:, -1].copy_(self.frame)

    def fill(self, mask: Tensor) -> None:
        """Set all frames of the worlds of ``mask`` (N,) bool to one made of the present signals."""
        self._signals.compute()
        self._mask.copy_(mask)
        self._fill()
