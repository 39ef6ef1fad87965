"""The interface between the trainer and a learning algorithm, and all algorithms by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from pace.config import plugins
from pace.config.schedules import Position
from pace.config.training import AlgoConfig
from pace.distributed import ProcessGroup
from pace.rl.agent import Sizes
from pace.rl.ppo import AsymmetricPPO
from pace.rl.rollout import VectorTask


class Algorithm(Protocol):
    """Acts in the worlds of a run and learns from the rollouts.

    The trainer makes one with ``(sizes, config, device, group)``, before the first step of any world. Then for each
    update: :meth:`prepare`, :meth:`begin`, :meth:`step` for each control step, :meth:`finish`, :meth:`fault`,
    :meth:`update`. Between the steps the trainer records the predictor's samples. All processes of the ``group`` do the
    same calls; each has separate worlds, and after an update all have the same weights.
    """

    def __init__(self, sizes: Sizes, config: AlgoConfig, device: torch.device, group: ProcessGroup) -> None: ...

    @property
    def agent(self) -> nn.Module:
        """All trained networks: its ``state_dict`` is the part "agent" of a checkpoint."""
        ...

    def prepare(self, env: VectorTask, at: Position) -> int:
        """Allocate storage for these worlds, ``at`` a place in the run.

        Returns the number of control steps of the next rollout. The worlds may differ from those of the last call.
        """
        ...

    def begin(self) -> None:
        """A rollout begins; the worlds' observations are those before its first step."""
        ...

    def step(self, t: int) -> None:
        """Step ``t`` of the rollout: observe, act, ``env.advance``, ``env.reset_worlds`` for those that are done."""
        ...

    def finish(self) -> None:
        """The rollout is over."""
        ...

    def fault(self) -> str | None:
        """A fault of the rollout, such as a value that is not finite, or None. May wait for the device."""
        ...

    def update(self, at: Position) -> Mapping[str, float | Tensor]:
        """Learn from the rollout; returns columns of the run's metrics, the same at each update: numbers, or tensors ()
        on the device, which the trainer reads together.

        Errors: :class:`pace.rl.rollout.RolloutError` if the run cannot continue.
        """
        ...

    def weights_loaded(self, new_run: bool) -> None:
        """Called after the weights of a checkpoint were loaded into ``agent``: for a resumed run or a ``new_run``."""
        ...

    def describe(self) -> str:
        """A few words for the line that announces a run, such as the networks' number format."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """The state for an exact resume besides the agent's weights: tensors, numbers and text in dictionaries."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`."""
        ...

    @staticmethod
    def load_policy(weights: Mapping[str, Tensor], sizes: Sizes, config: AlgoConfig, source: str) -> nn.Module:
        """The policy to evaluate, play and export, in float32: raw ``policy`` observation (N, Dp) -> action (N, J).

        ``weights``: the ``state_dict`` of ``agent``; the critic's number in ``sizes`` is not known. Errors:
        :class:`pace.runs.checkpoint.CheckpointError` that begins with ``source``, if the weights do not fit.
        """
        ...


@runtime_checkable
class InPlace(Protocol):
    """What an :class:`Algorithm` has besides if it leaves out the host.

    ``begin``, ``step`` and ``finish`` do the same work on the same tensors in each rollout, until :meth:`storage` is
    another one; so a rollout can be a graph (:class:`pace.arrays.graph.CapturedCall`). ``fault`` is only asked after
    the update, if the rollout was not :meth:`healthy`. The metrics of an update are finite, or it is undone.
    """

    def live_state(self) -> dict[str, Any]:
        """``state_dict`` with the tensors themselves, without a wait: it is copied before each update."""
        ...

    def storage(self) -> object:
        """What the rollout is stored in, after ``prepare``: another object has other tensors."""
        ...

    def healthy(self) -> Tensor:
        """Whether the rollout has no fault, () bool. Asked after each update, and read with the metrics."""
        ...

    def learned(self, metrics: Mapping[str, float]) -> None:
        """Called after an update, with all metrics of the run."""
        ...


def _accept(found: object) -> type[Algorithm]:
    if not isinstance(found, type):
        raise TypeError("an algorithm is a class that meets pace.rl.algorithm.Algorithm")
    return found


#: All algorithms by ``algo.algorithm``.
ALGORITHMS: plugins.Registry[type[Algorithm]] = plugins.Registry(
    "algorithm", plugins.ALGORITHMS, _accept, {"ppo": AsymmetricPPO}, where="algo.algorithm="
)
