"""Observations of actor and critic: two tables from name to (size, function), and their histories.

The functions of :data:`POLICY` take :class:`pace.onboard.actor.Signals`, which hold nothing but sensed signals and what
the robot computes from them, in the environment and in the exported file; those of :data:`CRITIC` take
:class:`TaskState`, the truth. So the actor cannot see the truth by accident: a privileged name in the policy's list is
a configuration error.

A group's observation (N, H * D) is its last H frames of D numbers, oldest first. At reset of a world all H frames are
the current one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.task import TaskConfig
from pace.onboard.actor import Onboard, PaddlePose, Predictor, Readings, Signals
from pace.onboard.ball_track import Track
from pace.onboard.estimate import columns
from pace.onboard.estimates import ESTIMATES, check
from pace.sim.sensing import Sensing
from pace.task.state import TaskState

JOINTS = 21


class ActorSignals(Signals):
    """All that the actor may see, of N worlds in place: each control step overwrites the same tensors.

    Besides the attributes of :class:`pace.onboard.actor.Signals`: ``onboard``, the modules that compute them, and
    ``predictor``, the one that is used.

    Args:
        config: the task.
        sensing: the robot's sensors.
        action: (N, J) the robot's own last action, kept up to date by its owner.
        paddle: forward kinematics of the paddle.
        predictor: callable (N, 3 * frames) -> (N, P), or ``None``.
    """

    def __init__(
        self,
        config: TaskConfig,
        sensing: Sensing,
        action: Tensor,
        paddle: PaddlePose,
        predictor: Predictor | None,
    ) -> None:
        self.onboard = Onboard(config, paddle, predictor).to(action.device)
        self._shift_noise = sensing.base_shift_noise
        readings = Readings(*(getattr(sensing, name) for name in Readings._fields))
        super().__init__(**vars(_allocate(self.onboard, readings, action)))

    @property
    def predictor(self) -> Predictor | None:
        """The predictor that is used, if any."""
        return self.onboard.predictor

    def step(self, new_ball: Tensor) -> None:
        """One control step later: ``sensing`` and ``action`` are new; ``new_ball`` (N,) bool: balls just launched."""
        with torch.no_grad(), torch.autocast(self.action.device.type, enabled=False):
            found = self.onboard(self.sensing, self.action, self.track, self.estimates, new_ball)
        if self.predictor is not None:
            found.shift = found.shift + self._shift_noise
        new = found.computed()
        for name, kept in self.computed().items():
            kept.copy_(new[name])

    def begin(self, mask: Tensor) -> None:
        """A new episode in the worlds of ``mask`` (N,) bool; the others stay as they are.

        On a CPU only those worlds are computed: looking costs no wait there, and few are new.
        """
        rows = mask.nonzero().squeeze(1) if mask.device.type == "cpu" else slice(None)
        with torch.no_grad(), torch.autocast(self.action.device.type, enabled=False):
            found = self.onboard.begin(Readings(*(reading[rows] for reading in self.sensing)), self.action[rows])
        if self.predictor is not None:
            found.shift = found.shift + self._shift_noise[rows]
        new = found.computed()
        for name, kept in self.computed().items():
            put(kept, new[name], mask, rows)


def _allocate(onboard: Onboard, readings: Readings, action: Tensor) -> Signals:
    """Zeros of the shapes of one step, made without a step: no predictor is asked."""
    count = len(action)

    def zeros(*size: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.zeros(count, *size, dtype=dtype, device=action.device)

    track = Track(zeros(3 * onboard.track.frames), zeros(dtype=torch.bool), zeros(dtype=torch.bool))
    estimates = {name: zeros(onboard.estimate(name).size) for name in onboard.estimates}
    return Signals(
        readings,
        action,
        track,
        prediction=zeros(onboard.reader.size),
        apex=zeros(3),
        target=zeros(3),
        time=zeros(),
        shift=zeros(2),
        paddle_position=zeros(3),
        paddle_normal=zeros(3),
        estimates=estimates,
    )


def put(kept: Tensor, new: Tensor, mask: Tensor, rows: Tensor | slice) -> None:
    """Write ``new`` into the worlds of ``mask`` (N,) of ``kept`` (N, ...): the values of ``rows``, which are those
    worlds, or of all, without looking which worlds they are."""
    if isinstance(rows, Tensor):
        kept[rows] = new
    else:
        kept.copy_(torch.where(mask.view(-1, *[1] * (kept.dim() - 1)), new, kept))


class ActorObservation(NamedTuple):
    """Size and function of one observation of the actor."""

    size: int
    function: Callable[[Signals], Tensor]


class CriticObservation(NamedTuple):
    """Size and function of one observation of the critic."""

    size: int
    function: Callable[[TaskState], Tensor]


def _column(values: Tensor) -> Tensor:
    return values.unsqueeze(-1)


#: Sensed, delayed, noisy signals, and what is computed from them in each control step.
SENSED: dict[str, ActorObservation] = {
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


class PolicyObservations(Mapping[str, ActorObservation]):
    """``SENSED``, and the parts of the estimates that are for the actor, as ``ESTIMATES`` has them now."""

    def _table(self) -> dict[str, ActorObservation]:
        return SENSED | {
            seen: _part_of(name, part) for name, entry in ESTIMATES.items() for seen, part in entry.observations.items()
        }

    def __getitem__(self, name: str) -> ActorObservation:
        return self._table()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._table())

    def __len__(self) -> int:
        return len(self._table())


def _part_of(estimate: str, part: str) -> ActorObservation:
    where = columns(ESTIMATES[estimate].make.parts(JOINTS))[part]
    return ActorObservation(where.stop - where.start, lambda s: s.estimates[estimate][:, where])


#: What the actor can see: ``SENSED`` and the estimates.
POLICY = PolicyObservations()

#: What the critic can see: the truth.
CRITIC: dict[str, CriticObservation] = {
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


def check_policy(config: TaskConfig) -> None:
    """Raise :class:`ConfigError` for a name that the actor may not see, or that nobody computes."""
    names, predictor = config.observation.policy, config.predictor
    _check_names("policy", names, POLICY)
    check(config)
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


class Frame:
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


class History:
    """The last H frames of N worlds.

    Attributes: ``frame`` (N, D) the newest, ``observation`` (N, H * D) all of them, oldest first, ``frames``
    (N, H, D) the same.

    Args: frames: H; functions: of the signals that make a frame, as :class:`Frame` wants them.
    """

    def __init__(self, frames: int, functions: Sequence[Callable[[], Tensor]]) -> None:
        self._signals = Frame(functions)
        tensors = self._signals.tensors
        size, count, device = sum(tensor.shape[1] for tensor in tensors), len(tensors[0]), tensors[0].device
        self.frame = torch.zeros(count, size, device=device)
        self.observation = torch.zeros(count, frames * size, device=device)
        self.frames = self.observation.view(count, frames, size)

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
        rows = mask.nonzero().squeeze(1) if mask.device.type == "cpu" else slice(None)
        frame = torch.cat([signal[rows] for signal in self._signals.tensors], dim=1)
        put(self.frame, frame, mask, rows)
        put(self.frames, frame.unsqueeze(1), mask, rows)
