"""The samples of one optimiser step, in buffers that all gathers write into."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict
from torch import Tensor

from pace.config.base import ConfigError
from pace.rl.rollout import Rollout


def minibatch_of(rollout: Rollout, sources: Mapping[str, Tensor], count: int) -> TensorDict:
    """Buffers for one of ``count`` minibatches of a rollout, by the loss's names; the policy's std is the rollout's.

    Args: sources: (steps * N, ...) tensors, as those that are gathered from.
    Errors: :class:`ConfigError` for more minibatches than samples.
    """
    samples = rollout.steps * rollout.num_worlds
    rows = samples // count
    if rows < 1:
        raise ConfigError(
            f"algo.minibatches {count} is more than the samples of an update, num_worlds x algo.steps = {samples}"
        )
    buffers = {name: torch.empty_like(source[:rows]) for name, source in sources.items()}
    return TensorDict(buffers | {"old_scale": rollout.scale.expand(rows, -1)}, batch_size=[rows])


def gather(sources: Mapping[str, Tensor], index: Tensor, batch: TensorDict) -> None:
    """Copy the rows ``index`` (rows,) of the sources into the buffers."""
    for name, source in sources.items():
        torch.index_select(source, 0, index, out=batch[name])
