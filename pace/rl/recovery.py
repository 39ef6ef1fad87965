"""Updates that are not finite: undone and counted, up to a number in a row; with a replay of what went wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from pace.config.base import to_dict
from pace.config.training import TrainConfig
from pace.devices import full_memory_in_words, out_of_memory
from pace.distributed import ProcessGroup
from pace.rl.rollout import RolloutError, TrainableTask
from pace.runs.checkpoint import Checkpoint, CheckpointError, save_checkpoint
from pace.runs.checkpoint_folders import LAST_GOOD
from pace.runs.files import say
from pace.runs.run_folder import RunFolder
from pace.sim.replay import save_replay

Row = dict[str, float]


@runtime_checkable
class Live(Protocol):
    """A learner whose tensors can be copied on the device."""

    def live_state(self) -> dict[str, Any]:
        """Its ``state_dict`` with the tensors themselves."""
        ...


class LastGood:
    """A copy of everything that an update changes in a learner, renewed before each update and put back after a fault.

    Args: networks: by their part of a checkpoint; learners: objects with ``state_dict`` and ``load_state_dict``, such
    as an algorithm with its optimisers. One that has a ``live_state`` besides is copied without a wait for the device.
    """

    def __init__(self, networks: Mapping[str, nn.Module], learners: Mapping[str, Any]) -> None:
        self._networks, self._learners = networks, learners
        self._state: dict[str, Any] = {}
        self._kept: list[Tensor] = []

    @torch.no_grad()
    def keep(self) -> None:
        """Copy the current state, into the copies of before if the tensors are of the same kind."""
        live: dict[str, Any] = {name: part.state_dict() for name, part in self._networks.items()}
        for name, part in self._learners.items():
            live[name] = part.live_state() if isinstance(part, Live) else part.state_dict()
        tensors: list[Tensor] = []
        _replaced(live, lambda tensor: tensors.append(tensor) or tensor)
        kinds = [[(tensor.shape, tensor.dtype) for tensor in each] for each in (tensors, self._kept)]
        if tensors and kinds[0] == kinds[1]:
            torch._foreach_copy_(self._kept, tensors)
        else:
            self._kept = [tensor.detach().clone() for tensor in tensors]
        copies = iter(self._kept)
        self._state = _replaced(live, lambda _: next(copies))

    def weights(self) -> dict[str, dict[str, Tensor]]:
        """Copies of the networks' weights, by part."""
        return _replaced({name: self._state[name] for name in self._networks}, Tensor.clone)

    @torch.no_grad()
    def restore(self) -> None:
        """Put the kept state back."""
        for name, part in (*self._networks.items(), *self._learners.items()):
            part.load_state_dict(_replaced(self._state[name], Tensor.clone))  # it may keep what it is given


def _replaced(state: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """Nested dictionaries and lists with each tensor replaced, always in the same order."""
    if isinstance(state, Tensor):
        return change(state)
    if isinstance(state, Mapping):
        return {name: _replaced(item, change) for name, item in state.items()}
    if isinstance(state, list | tuple):
        return [_replaced(item, change) for item in state]
    return state


class Recovery:
    """Tries updates, and undoes those that are not finite.

    Attributes: ``in_a_row``, updates skipped since the last good one.

    Args: ``run`` is None on other ranks than 0; the others as for :class:`LastGood`.
    """

    def __init__(
        self,
        config: TrainConfig,
        networks: Mapping[str, nn.Module],
        learners: Mapping[str, Any],
        run: RunFolder | None,
        group: ProcessGroup,
    ) -> None:
        self.in_a_row = 0
        self._config, self._run, self._group = config, run, group
        self._good = LastGood(networks, learners)
        self._good_at: dict[str, float] = {}

    def attempt(self, update: Callable[[], Row], env: TrainableTask, counters: dict[str, float]) -> Row | None:
        """The row of an update after ``counters``; None if it is skipped: it was not finite, and is undone.

        Errors: :class:`RolloutError` for one more than ``algo.skips`` in a row, and for a GPU whose memory is full. The
        weights before them are then saved beside the checkpoints.
        """
        self._good.keep()
        self._good_at = counters if self.in_a_row == 0 else self._good_at
        number = int(counters["updates"]) + 1
        try:
            row = update()
        except RolloutError as error:
            self._good.restore()
            self._write_replay(env, number, str(error))
            env.pop_statistics()  # of a rollout that is not learned from
            self.in_a_row += 1
            if self.in_a_row > self._config.algo.skips:
                raise self._last_words(error) from error
            if self._run is not None:
                say(f"warning: update {number} is skipped: {error}")
            return None
        except RuntimeError as error:
            if not out_of_memory(error) or number == 1:
                raise
            torch.cuda.empty_cache()
            raise self._last_words(RolloutError(full_memory_in_words(error, env.policy_observation.device))) from error
        self.in_a_row = 0
        if row.get("diverged", 0.0) > 0:
            self._write_replay(env, number, "diverged")
        return row

    def _last_words(self, error: RolloutError) -> RolloutError:
        if self._run is None:
            return error
        checkpoint = Checkpoint(to_dict(self._config), self._good_at, self._good.weights(), None)
        try:
            folder = save_checkpoint(self._run.path / LAST_GOOD, checkpoint)
        except CheckpointError as failure:
            return RolloutError(f"{error}; the weights before could not be saved: {failure}")
        return RolloutError(f"{error}; the weights before this update are in {folder}")

    def _write_replay(self, env: TrainableTask, update: int, reason: str) -> None:
        """Write the last control steps of worlds whose numbers went wrong, of all ranks, if they are remembered."""
        count = len(env.reward)
        worlds = [
            replace(replay, world=rank * count + replay.world)
            for rank, replays in enumerate(self._group.gather(env.replays()))
            for replay in replays
        ]
        if worlds and self._run is not None:
            config = to_dict(self._config)
            self._run.save_replay(update, lambda file: save_replay(file, worlds, config, reason))
