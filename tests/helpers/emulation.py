"""A GPU's ways on a CPU: the branches that it takes, and a stand-in for the CUDA graph of a call."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import warp as wp
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from warp._src import context as warp_context

from pace.task.env import TableTennisEnv


class OnGpu(Tensor):
    """A mask that says it lies on a GPU."""

    @property
    def device(self) -> Any:  # type: ignore[override]
        return SimpleNamespace(type="cuda")


def take_the_gpus_way(env: TableTennisEnv) -> None:
    """With masks on a CPU, three places read which worlds restart, to do less work, and the solver checks whether
    all worlds have converged; on a GPU none does this."""

    def on_gpu(function: Any, place: int) -> Any:
        return lambda *args: function(*args[:place], args[place].as_subclass(OnGpu), *args[place + 1 :])

    env.worlds.engine.model.opt.graph_conditional = False  # type: ignore[attr-defined]
    env.worlds.device = SimpleNamespace(type="cuda")  # type: ignore[assignment]
    env.actor.begin = on_gpu(env.actor.begin, 0)  # type: ignore[method-assign]
    for history in (env._policy_history, env._critic_history):
        history.fill = on_gpu(history.fill, 0)  # type: ignore[method-assign]


Replay = Callable[[], object]


class Recording(TorchDispatchMode):
    """One call's operators and launches, with the numbers and addresses they were given, to be done again.

    What a CUDA graph keeps, no more: Python does not run again, numbers are those of the recorded call, and temporary
    tensors and arrays stay in place. Only random numbers continue, as those of a registered generator do.
    Unlike a capture, recording does the work too; so the first :meth:`replay` does nothing.
    """

    def __init__(self, function: Callable[..., None], inputs: tuple[Tensor, ...]) -> None:
        super().__init__()
        self.steps: list[Replay] = []
        self._done = False
        with torch.no_grad(), self, self._record_warp():
            function(*inputs)

    def replay(self) -> None:
        """Do it again."""
        if self._done:
            with torch.no_grad(), _memory_kept():
                for step in self.steps:
                    step()
        self._done = True

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        result = func(*args, **kwargs)
        self.steps.append(lambda: _overwrite(func, result, func(*args, **kwargs)))
        return result

    @contextmanager
    def _record_warp(self) -> Iterator[None]:
        """On a CPU all launches of Warp pass two functions, and what is no launch is a copy, or fills an array."""
        with pytest.MonkeyPatch.context() as patch, _memory_kept():
            for name in ("invoke", "invoke_cpu_blocks"):
                patch.setattr(warp_context, name, self._launching(getattr(warp_context, name)))
            patch.setattr(wp, "copy", self._recorded(wp.copy))
            for name in ("zero_", "fill_"):
                patch.setattr(wp.array, name, self._recorded(getattr(wp.array, name)))
            yield

    def _launching(self, invoke: Any) -> Any:
        def launch(kernel: Any, hooks: Any, params: Any, adjoint: bool) -> None:
            kept = [type(value).from_buffer_copy(value) if isinstance(value, CTYPES) else value for value in params]
            self.steps.append(lambda: invoke(kernel, hooks, kept, adjoint))
            invoke(kernel, hooks, params, adjoint)

        return launch

    def _recorded(self, function: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            self.steps.append(lambda: function(*args, **kwargs))
            return function(*args, **kwargs)

        return call


CTYPES = (ctypes.Structure, ctypes.Array, ctypes._SimpleCData)


@contextmanager
def _memory_kept() -> Iterator[None]:
    """Warp frees no array meanwhile: the memory of those within the call belongs to the recording."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wp.array, "__del__", lambda _: None)
        yield


def _overwrite(func: Any, recorded: Any, result: Any) -> None:
    """Put new results where the recorded ones lie; views, and what works in place, lie there already."""
    recorded, result = ([given] if isinstance(given, Tensor) else given for given in (recorded, result))
    for returned, old, new in zip(func._schema.returns, recorded or (), result or (), strict=False):
        if returned.alias_info is None and isinstance(old, Tensor):
            old.copy_(new)
