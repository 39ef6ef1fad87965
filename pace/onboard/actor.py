"""One control step of all on-board estimators between a robot's readings and its policy network."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pace.config.task import TaskConfig
from pace.onboard.ball_track import BallTrack, Track
from pace.onboard.estimate import Estimate
from pace.onboard.estimates import Entry, make_estimates, observed
from pace.onboard.prediction import Prediction, PredictionReader, no_prediction
from pace.sim.robot import nominal_pose

Predictor = Callable[[Tensor], Tensor]
#: Base position (N, 3) m, gravity (N, 3), heading (N, 2), joints (N, J) rad -> centre (N, 3) m and normal (N, 3).
PaddlePose = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
#: Name of an estimate and the signals that it reads, by name -> its new state (N, S).
Advance = Callable[[str, dict[str, Tensor]], Tensor]


class Readings(NamedTuple):
    """One frame of the sensors, as those of :class:`pace.sim.sensing.Sensing`: ``base_angular_velocity`` (N, 3) rad/s
    and ``projected_gravity`` (N, 3), body frame; ``base_position``, ``ball_position`` (N, 3) m and ``heading`` (N, 2),
    world frame; ``joint_position`` (N, J) rad relative to the nominal pose, ``joint_velocity`` (N, J) rad/s;
    ``base_age`` (N,) s since the frame with base position and heading was captured, ``base_new`` (N,) bool, it arrived
    since the last control step (else its values are repeated); ``ball_age`` and ``ball_new`` (N,), the same of the
    frame with the ball."""

    base_angular_velocity: Tensor
    base_position: Tensor
    projected_gravity: Tensor
    heading: Tensor
    joint_position: Tensor
    joint_velocity: Tensor
    ball_position: Tensor
    base_age: Tensor
    base_new: Tensor
    ball_age: Tensor
    ball_new: Tensor


@dataclass
class Signals:
    """All inputs of the actor.

    Attributes: ``sensing``, the readings; ``action`` (N, J) the previous action; ``track`` of the ball; ``prediction``
    (N, P) raw output; ``apex``, ``target`` (N, 3) m predicted, ``time`` (N,) s until the ball is at the target,
    ``shift`` (N, 2) m from the sensed base to its target; ``paddle_position`` (N, 3) m, ``paddle_normal``
    (N, 3); ``estimates``, the state (N, S) of each estimate by name.
    """

    sensing: Readings
    action: Tensor
    track: Track
    prediction: Tensor
    apex: Tensor
    target: Tensor
    time: Tensor
    shift: Tensor
    paddle_position: Tensor
    paddle_normal: Tensor
    estimates: dict[str, Tensor]

    def computed(self) -> dict[str, Tensor]:
        """All but readings and action, by their names in checkpoints."""
        names = ("prediction", "apex", "target", "time", "shift", "paddle_position", "paddle_normal")
        track = {f"track.{name}": value for name, value in self.track._asdict().items()}
        own = {f"actor.{name}": getattr(self, name) for name in names}
        return track | own | {f"{name}.state": state for name, state in self.estimates.items()}


class Onboard(nn.Module):
    """The steps in their order: the ball's track; the estimates that the paddle's pose is computed from; that pose; the
    prediction; the other estimates.

    While there is nothing to hit, the idle point replaces the prediction. Without a predictor (ablation)
    the predicted quantities are zero.

    Args:
        config: the task.
        paddle: forward kinematics of the paddle (:class:`pace.onboard.kinematics.PaddleChain`).
        predictor: callable (N, 3 * frames) -> (N, P), or ``None``.

    Errors: :class:`pace.config.ConfigError` for an estimate without its numbers.
    """

    nominal: Tensor

    def __init__(self, config: TaskConfig, paddle: PaddlePose, predictor: Predictor | None) -> None:
        super().__init__()
        nominal = torch.tensor(nominal_pose(config.robot), dtype=torch.float32)
        self.register_buffer("nominal", nominal, persistent=False)
        self.track, self.reader = BallTrack(config), PredictionReader(config)
        self.entries = observed(config.observation)
        #: Those that the paddle's pose is computed from, and the others.
        self.before = {name: entry for name, entry in self.entries.items() if entry.replaces}
        self.after = {name: entry for name, entry in self.entries.items() if not entry.replaces}
        self.estimates = nn.ModuleDict(make_estimates(config, len(nominal)))
        self.paddle = paddle
        self.predictor = predictor if config.predictor.enabled else None

    def estimate(self, name: str) -> Estimate:
        """One of the policy's estimates."""
        found = self.estimates[name]
        assert isinstance(found, Estimate)
        return found

    def begin(self, sensing: Readings, action: Tensor) -> Signals:
        """The first step of an episode."""
        track = self.track.begin(sensing.ball_position, sensing.ball_age)
        return self._complete(sensing, action, track, lambda name, reads: self.estimate(name).begin(**reads))

    def forward(
        self,
        sensing: Readings,
        action: Tensor,
        track: Track,
        estimates: Mapping[str, Tensor],
        started: Tensor | None = None,
    ) -> Signals:
        """The signals after one more control step.

        Args: sensing: the readings; action (N, J) of the step; track, estimates: those of :class:`Signals` of the
        previous step; started (N,) bool: the other worlds begin as in :meth:`begin`, and their previous step is
        ignored; ``None``: all have started.
        """
        track = self.track(track, sensing.ball_position, sensing.ball_age, sensing.ball_new, started)

        def advance(name: str, reads: dict[str, Tensor]) -> Tensor:
            later = self.estimate(name)(estimates[name], **reads)
            if started is None:
                return later
            return torch.where(started.unsqueeze(1), later, self.estimate(name).begin(**reads))

        return self._complete(sensing, action, track, advance)

    def _complete(self, sensing: Readings, action: Tensor, track: Track, advance: Advance) -> Signals:
        """All signals from readings, ball track and the estimates' previous states."""
        known = {**sensing._asdict(), "action": action, "track": track.positions}
        known |= {"turned": track.turned, "something_to_hit": track.something_to_hit}
        states = _advanced(self.before, known, advance)
        paddle = self._paddle_pose(sensing, states)
        output, prediction = self._predict(track, sensing.base_position)
        known |= {"paddle_position": paddle[0], "paddle_normal": paddle[1], **prediction._asdict()}
        states |= _advanced(self.after, known, advance)
        return Signals(sensing, action, track, output, *prediction, *paddle, states)

    def _paddle_pose(self, sensing: Readings, states: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """The paddle's pose from the estimates' states, or from the readings that no estimate replaces."""
        seen = sensing._asdict()
        for name, state in states.items():
            columns = self.estimate(name).columns
            seen |= {reading: state[:, columns[part]] for reading, part in self.entries[name].replaces.items()}
        joints = seen["joint_position"] + self.nominal
        return self.paddle(seen["base_position"], seen["projected_gravity"], seen["heading"], joints)

    def _predict(self, track: Track, base_position: Tensor) -> tuple[Tensor, Prediction]:
        if self.predictor is None:
            nothing = torch.zeros_like(base_position[:, :1]).expand(-1, self.reader.size)
            return nothing, no_prediction(base_position)
        output = self.predictor(track.positions)
        return output, self.reader(output, track.something_to_hit, base_position)


def _advanced(entries: Mapping[str, Entry], known: Mapping[str, Tensor], advance: Advance) -> dict[str, Tensor]:
    """New states of these estimates, from the signals that are known."""
    return {name: advance(name, {read: known[read] for read in entry.reads}) for name, entry in entries.items()}
