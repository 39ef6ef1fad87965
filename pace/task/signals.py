"""Sensed signals and on-board estimates of N worlds: tensors that are allocated once and updated in place."""

from __future__ import annotations

import torch
from torch import Tensor

from pace.arrays.graph import may_look
from pace.config.task import TaskConfig
from pace.onboard.actor import Onboard, PaddlePose, Predictor, Readings, Signals
from pace.onboard.ball_track import Track
from pace.sim.sensing import Sensing


class ActorSignals(Signals):
    """All inputs of the actor, of N worlds: each control step overwrites the same tensors.

    Besides the attributes of :class:`pace.onboard.actor.Signals`: ``onboard``, the modules that compute them, and
    ``predictor``, if there is one.

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
        """The predictor, if any."""
        return self.onboard.predictor

    def step(self) -> None:
        """Update after a control step: ``sensing`` and ``action`` are new."""
        with torch.no_grad(), torch.autocast(self.action.device.type, enabled=False):
            found = self.onboard(self.sensing, self.action, self.track, self.estimates)
        if self.predictor is not None:
            found.shift = found.shift + self._shift_noise
        new = found.computed()
        for name, kept in self.computed().items():
            kept.copy_(new[name])

    def begin(self, mask: Tensor) -> None:
        """A new episode in the worlds of ``mask`` (N,) bool; the others do not change.

        On a CPU only those worlds are computed: reading the mask costs no wait there, and few worlds are new.
        """
        rows = mask.nonzero().squeeze(1) if may_look(mask) else slice(None)
        with torch.no_grad(), torch.autocast(self.action.device.type, enabled=False):
            found = self.onboard.begin(Readings(*(reading[rows] for reading in self.sensing)), self.action[rows])
        if self.predictor is not None:
            found.shift = found.shift + self._shift_noise[rows]
        new = found.computed()
        for name, kept in self.computed().items():
            put(kept, new[name], mask, rows)


def _allocate(onboard: Onboard, readings: Readings, action: Tensor) -> Signals:
    """Zeros of the shapes of one step, made without calling a predictor."""
    count = len(action)

    def zeros(*size: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.zeros(count, *size, dtype=dtype, device=action.device)

    track = Track(zeros(3 * onboard.track.frames), zeros(dtype=torch.bool), zeros(dtype=torch.bool), zeros())
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
    """Write ``new`` into the worlds of ``mask`` (N,) of ``kept`` (N, ...). ``new`` holds the values of ``rows``, which
    are those worlds, or without ``rows`` the values of all worlds."""
    if isinstance(rows, Tensor):
        kept[rows] = new
    else:
        kept.copy_(torch.where(mask.view(-1, *[1] * (kept.dim() - 1)), new, kept))
