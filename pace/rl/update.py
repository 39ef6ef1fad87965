"""One update of a run: a rollout, the predictor's fit and the algorithm's, read by the host once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import torch
from torch import Tensor, nn

from pace.arrays.graph import CapturedCall, Graphs
from pace.arrays.launch import Bound
from pace.config.schedules import Position
from pace.distributed import ProcessGroup
from pace.predictor.regression import PredictorTrainer
from pace.rl.algorithm import Algorithm, InPlace
from pace.rl.rates import rates
from pace.rl.rollout import RolloutError, TrainableTask, require_finite
from pace.runs.reading import read

UNHEALTHY = "unhealthy"  # processes with a fault


class Update:
    """Rolls out, fits the predictor and lets the algorithm learn, together with the other processes of the ``group``.

    An algorithm that is :class:`InPlace` waits for the device once, at the end: the metrics, all checks and the counts
    of the task are one message. A fault is found only then, and the weights are no longer good: the caller has a copy
    of those before (:class:`pace.rl.recovery.Recovery`).

    Args: networks: all that are trained.
    """

    def __init__(
        self,
        algorithm: Algorithm,
        regression: PredictorTrainer,
        networks: Sequence[nn.Module],
        control_dt: float,
        group: ProcessGroup,
    ) -> None:
        self.algorithm, self.regression, self.group = algorithm, regression, group
        self._in_place = algorithm if isinstance(algorithm, InPlace) else None
        self._weights = [parameter.detach() for network in networks for parameter in network.parameters()]
        self._control_dt = control_dt
        self._roll_out = Bound(self._make_roll_out, env=None, storage=None, samples=None)

    def __call__(self, env: TrainableTask, at: Position) -> dict[str, float]:
        """One update in the worlds of ``env``, ``at`` a place in the run; returns its metrics.

        Errors: :class:`RolloutError`, on every rank, if one of them has a fault. The weights must then be put back.
        """
        self._play(env, at)
        if self._in_place is None:
            self._require_no_fault()
        prediction, learning = self.regression.learn(), self.algorithm.update(at)
        counted = env.pop_statistics()
        sums = torch.stack([value.float() for value in (~self._healthy(), *counted.values())])
        unhealthy, *sums = self.group.all_reduce_sum_(sums).unbind()
        row = read({**dict(zip(counted, sums, strict=True)), **prediction, **learning, UNHEALTHY: unhealthy})
        self._require_health(row.pop(UNHEALTHY) > 0, {name: row[name] for name in learning})
        task = rates({name: row.pop(name) for name in counted}, self._control_dt)
        if self._in_place is not None:
            self._in_place.learned(row)
        return task | row

    def _play(self, env: TrainableTask, at: Position) -> None:
        """One rollout, recorded for the predictor."""
        steps = self.algorithm.prepare(env, at)
        if steps != self.regression.steps:
            self.regression.resize(steps)
        self.algorithm.begin()
        storage = self._in_place.storage() if self._in_place else None
        self._roll_out(env, storage, self.regression.inputs)()
        self.algorithm.finish()

    def _make_roll_out(self, env: TrainableTask, storage: object, samples: Tensor) -> CapturedCall:
        """All steps in these worlds, into this storage and that of the regression, one of which is ``samples``."""
        graphs = Graphs.NONE if storage is None else env.graphs
        return CapturedCall(partial(self._steps, env, len(samples)), samples.device, graphs, env.generator)

    @torch.no_grad()
    def _steps(self, env: TrainableTask, steps: int) -> None:
        for t in range(steps):
            self.regression.record(t, env)
            self.algorithm.step(t)

    def _healthy(self) -> Tensor:
        """Whether the weights are finite, and the rollout has no fault if that has not been asked, ()."""
        finite = nn.utils.get_total_norm(self._weights).isfinite()
        return finite if self._in_place is None else finite & self._in_place.healthy()

    def _require_health(self, unhealthy: bool, learning: Mapping[str, float]) -> None:
        """Errors: :class:`RolloutError` for a fault of the rollout, or for metrics or weights that are not finite."""
        if unhealthy and self._in_place is not None:
            self._require_no_fault()
        if self._in_place is not None:
            require_finite(learning)
        if unhealthy:
            raise RolloutError("not finite: the weights after the update")

    def _require_no_fault(self) -> None:
        """Errors: :class:`RolloutError`, on every rank, if the rollout of one of them has a fault."""
        faults = [fault for fault in self.group.gather(self.algorithm.fault()) if fault is not None]
        if faults:
            raise RolloutError(faults[0])
