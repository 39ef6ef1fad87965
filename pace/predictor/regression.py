"""Online regression of the predictor on the last rollout, and its error on that rollout before the fit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from pace.arrays.gradients import Gradients
from pace.arrays.graph import CapturedCall, Graphs
from pace.config.predictor import PredictorConfig
from pace.distributed import ProcessGroup
from pace.predictor.network import BallPredictor
from pace.runs.optimiser import adam, live_state, load_optimiser_state, optimiser_state
from pace.runs.reading import read

TIME_BINS = (0.0, 0.1, 0.2, 0.3, 0.4)  # s before the apex; the first and the last bin are open
BIN_NAMES = ("after_apex", "0_0.1s", "0.1_0.2s", "0.2_0.3s", "0.3_0.4s", "over_0.4s")


class PredictorSource(Protocol):
    """What the regression reads from the environment at each control step."""

    predictor_input: Tensor  # (N, 3 frames) sensed ball positions, m, oldest first
    predictor_target: Tensor  # (N, out) simulated truth
    predictor_valid: Tensor  # (N,) bool: the target exists and the ball is on its way to it
    predictor_time_to_apex: Tensor  # (N,) s


class PredictorTrainer:
    """Adam on a :class:`BallPredictor`, which it changes in place, over samples of the last (steps, N) rollout.

    After ``config.train_updates`` updates the network is frozen (0: never); errors are still measured. The processes of
    a ``group`` share the samples of a batch. With ``graphs`` the measurement and the fit are a graph each; in a group
    the fit is several, with the exchange of the gradients between them.
    """

    def __init__(
        self,
        network: BallPredictor,
        config: PredictorConfig,
        steps: int,
        num_worlds: int,
        group: ProcessGroup | None = None,
        graphs: Graphs = Graphs.NONE,
    ) -> None:
        parameters = list(network.parameters())
        device = parameters[0].device
        self.network, self.config, self.group = network, config, group or ProcessGroup()
        self.updates = 0
        self.optimiser = adam(parameters, config.learning_rate)
        self._gradients = Gradients(parameters)
        if self.group.size > 1 or graphs is not Graphs.NONE:
            self._gradients.hold()
        self._num_worlds, self._device, self._first_steps, self._graphs = num_worlds, device, steps, graphs
        self._edges = torch.tensor(TIME_BINS, device=device)
        self._sums = torch.zeros(2, len(BIN_NAMES), device=device)
        self.resize(steps)

    def resize(self, steps: int) -> None:
        """Take rollouts of ``steps`` from now on; an update then has proportionally many batches."""
        worlds, device = self._num_worlds, self._device
        self.steps = steps
        self.inputs = torch.zeros(steps, worlds, self.network.input_size, device=device)
        self.targets = torch.zeros(steps, worlds, self.network.output_size, device=device)
        self.valid = torch.zeros(steps, worlds, dtype=torch.bool, device=device)
        self.time_to_apex = torch.zeros(steps, worlds, device=device)
        self._by_validity = torch.zeros(steps * worlds, dtype=torch.long, device=device)
        self._count = torch.zeros((), dtype=torch.long, device=device)
        self._batches = max(1, round(self.config.batches_per_update * steps / self._first_steps))
        self._capture()

    def _capture(self) -> None:
        """New graphs: those of before read the tensors of before."""
        self._measure = CapturedCall(self._sum_errors, self._device, self._graphs)
        self._sort = CapturedCall(self._sort_by_validity, self._device, self._graphs)
        self._differentiate = CapturedCall(self._differentiate_batch, self._device, self._graphs)
        self._apply = CapturedCall(self._step, self._device, self._graphs)
        self._fit = CapturedCall(self._fit_batches, self._device, self._graphs if self.group.size == 1 else Graphs.NONE)

    @property
    def frozen(self) -> bool:
        """Whether the network is frozen."""
        return not self.config.enabled or 0 < self.config.train_updates <= self.updates

    @torch.no_grad()
    def record(self, t: int, source: PredictorSource) -> None:
        """Store the current step of all worlds in row ``t``."""
        self.inputs[t].copy_(source.predictor_input)
        self.valid[t].copy_(source.predictor_valid)
        self.targets[t].copy_(torch.where(source.predictor_valid[:, None], source.predictor_target, 0.0))
        self.time_to_apex[t].copy_(source.predictor_time_to_apex)

    def update(self) -> dict[str, float]:
        """Measure the error on the recorded samples, then fit them; returns the metrics of :meth:`errors`."""
        return read(self.learn())

    def learn(self) -> Mapping[str, float | Tensor]:
        """:meth:`update` without a wait for the device: the metrics are tensors ()."""
        metrics = self.measure()
        if not self.frozen:
            self._fit()
            self.updates += 1
        return metrics

    def errors(self) -> dict[str, float]:
        """RMSE of the apex (3-D, cm): ``predictor_rmse_cm``, and ``predictor_rmse_cm/<bin>`` by time before the apex.

        A bin without a sample is NaN; with the predictor switched off, all are.
        """
        return read(self.measure())

    @torch.no_grad()
    def measure(self) -> Mapping[str, float | Tensor]:
        """:meth:`errors` without a wait for the device, as tensors ()."""
        names = ["predictor_rmse_cm", *(f"predictor_rmse_cm/{name}" for name in BIN_NAMES)]
        if not self.config.enabled:
            return dict.fromkeys(names, math.nan)
        self._measure()
        self.group.all_reduce_sum_(self._sums)
        totals = torch.cat([self._sums.sum(1, keepdim=True), self._sums], dim=1)
        return dict(zip(names, (100.0 * (totals[0] / totals[1]).sqrt()).unbind(), strict=True))

    def _sum_errors(self) -> None:
        """Squared errors of the apex, m^2, and samples, by time."""
        predicted = self.network(self.inputs.flatten(0, 1))
        columns = self.network.slices["apex"]
        squared = (predicted - self.targets.flatten(0, 1))[:, columns].square().sum(1)
        weight = self.valid.flatten().to(squared.dtype)
        bins = torch.bucketize(self.time_to_apex.flatten(), self._edges, right=True)
        self._sums.zero_()
        self._sums[0].index_add_(0, bins, squared * weight)
        self._sums[1].index_add_(0, bins, weight)

    def _fit_batches(self) -> None:
        """``batches_per_update`` steps of Adam, more for longer rollouts, on valid samples."""
        self._sort()
        for _ in range(self._batches):
            self._differentiate()
            self.group.all_reduce_mean_([self._gradients.flat])
            self._apply()

    def _sort_by_validity(self) -> None:
        valid = self.valid.flatten()
        self._by_validity.copy_(torch.argsort(valid, descending=True, stable=True))
        self._count.copy_(valid.sum())

    def _differentiate_batch(self) -> None:
        """Gradients on samples that are drawn with replacement, and without a host sync."""
        inputs, targets = self.inputs.flatten(0, 1), self.targets.flatten(0, 1)
        uniform = torch.rand(max(1, self.config.batch_size // self.group.size), device=self._device)
        index = self._by_validity[(uniform * self._count).long()]
        error = self.network.scaled(inputs[index]) - self.network.scale_target(targets[index])
        valid = self.valid.flatten()[index]
        loss = (error.square().mean(1) * valid).mean()  # zero if the rollout had no valid sample
        self._gradients.zero_()
        loss.backward()

    def _step(self) -> None:
        self.optimiser.step()

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments and the count of updates; the network's weights are saved with the policy's."""
        return {"updates": self.updates, **optimiser_state(self.optimiser)}

    def live_state(self) -> dict[str, Any]:
        """:meth:`state_dict` without a wait for the device: the tensors themselves."""
        return {"updates": self.updates, **live_state(self.optimiser)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`."""
        self.updates = int(state["updates"])
        load_optimiser_state(self.optimiser, state)
