"""What the trainer asks of a learning algorithm, and all algorithms by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from pace.config import plugins
from pace.config.training import AlgoConfig
from pace.distributed import ProcessGroup
from pace.rl.agent import Sizes
from pace.rl.ppo import AsymmetricPPO
from pace.rl.rollout import VectorTask


class Algorithm(Protocol):
    """Acts in the worlds of a run and learns from what happens there.

    The trainer makes one with ``(sizes, config, device, group)``, before any world has moved. Then for each update:
    :meth:`prepare`, :meth:`begin`, :meth:`step` for each control step, :meth:`finish`, :meth:`fault`, :meth:`update`.
    Between the steps the trainer records what the predictor learns from. All processes of the ``group`` do the same
    calls; each has worlds of its own, and after an update the same weights.
    """

    def __init__(self, sizes: Sizes, config: AlgoConfig, device: torch.device, group: ProcessGroup) -> None: ...

    @property
    def agent(self) -> nn.Module:
        """All that is learned: its ``state_dict`` is the part "agent" of a checkpoint."""
        ...

    def prepare(self, env: VectorTask, samples: float) -> int:
        """Make room for these worlds, ``samples`` control steps into the run.

        Returns the number of control steps of the next rollout. Worlds may be others than before.
        """
        ...

    def begin(self) -> None:
        """A rollout begins; the worlds' observations are those before its first step."""
        ...

    def step(self, t: int) -> None:
        """Step ``t`` of the rollout: observe, act, ``env.advance``, ``env.reset_worlds`` where one is done."""
        ...

    def finish(self) -> None:
        """The rollout is over."""
        ...

    def fault(self) -> str | None:
        """What cannot be learned from in the rollout, such as a value that is not finite. May wait for the device."""
        ...

    def update(self, samples: float) -> dict[str, float]:
        """Learn from the rollout; returns columns of the run's metrics, the same at each update.

        Errors: :class:`pace.rl.rollout.RolloutError` for what the run cannot go on with.
        """
        ...

    def weights_loaded(self, new_run: bool) -> None:
        """``agent`` has got the weights of a checkpoint, to resume its run or for a ``new_run``."""
        ...

    def describe(self) -> str:
        """For the line that announces a run: what its networks compute in, or the like."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """What an exact resume needs besides the agent's weights: tensors, numbers and text in dictionaries."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        ...

    @staticmethod
    def load_policy(weights: Mapping[str, Tensor], sizes: Sizes, config: AlgoConfig, source: str) -> nn.Module:
        """The policy to evaluate, play and export, in float32: raw ``policy`` observation (N, Dp) -> action (N, J).

        ``weights``: the ``state_dict`` of ``agent``; of ``sizes`` the critic's is not known. Errors:
        :class:`pace.runs.checkpoint.CheckpointError` that begins with ``source``, for weights that do not fit.
        """
        ...


def _accept(found: object) -> type[Algorithm]:
    if not isinstance(found, type):
        raise TypeError("an algorithm is a class that meets pace.rl.algorithm.Algorithm")
    return found


#: All algorithms by ``algo.algorithm``.
ALGORITHMS: plugins.Registry[type[Algorithm]] = plugins.Registry(
    "algorithm", plugins.ALGORITHMS, _accept, {"ppo": AsymmetricPPO}, where="algo.algorithm="
)
