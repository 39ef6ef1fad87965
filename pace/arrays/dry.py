"""What a CUDA graph keeps of a call, kept on a CPU: for ``engine.graph=dry``, which goes a GPU's way without one.

It shows what a graph can hold; it does not show streams, memory pools and NCCL.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map_only

from pace.arrays.dry_warp import WarpWork
from pace.arrays.steps import Comparer, Step, given
from pace.arrays.watch import place, require_no_wait, watched


class Recording:
    """One call, with the numbers and addresses that it was given, to be done again.

    It keeps what a graph keeps, no more: Python does not run again, numbers are those of the recorded call, and
    temporary tensors and arrays stay in place. Only random numbers continue, as those of a registered generator do.
    Unlike a capture, recording does the work too; so the first :meth:`replay` does nothing. Before every second of the
    others the function runs once more without an effect, and its steps are compared with the recorded ones.

    Args: function: of the tensors ``inputs``.
    Errors: :class:`pace.arrays.watch.DryRunError`, which names what a graph could not hold.
    """

    def __init__(self, function: Callable[..., None], inputs: tuple[Tensor, ...]) -> None:
        self._function, self._inputs, self._replays = function, inputs, 0
        self._steps: list[Step] = []
        self._warp = WarpWork()
        with watched(), self._warp.recording(self._steps), _Recorder(self._steps):
            function(*inputs)

    def replay(self) -> None:
        """Do it again."""
        self._replays += 1
        if self._replays == 1:
            return
        if self._replays % 2 == 0:
            self._compare()
        with torch.no_grad():
            for step in self._steps:
                step.again()

    def _compare(self) -> None:
        comparer = Comparer(self._steps)
        with watched(), self._warp.comparing(comparer), _Pretender(comparer):
            self._function(*self._inputs)
        comparer.finish()


class _Mode(TorchDispatchMode):
    """Sees every operator of torch, those of a backward pass too."""

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func.namespace == "profiler":  # the marks of an optimiser's step
            return func(*args, **kwargs)
        require_no_wait(func, args)
        return self.do(func, args, kwargs)

    def do(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """The operator's result."""
        raise NotImplementedError


class _Recorder(_Mode):
    """Does the operators, and records them. It keeps their tensors, or others would get the same addresses."""

    def __init__(self, steps: list[Step]) -> None:
        super().__init__()
        self._steps = steps

    def do(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        result = func(*args, **kwargs)
        kept_args, kept_kwargs, kept = _alias((args, kwargs, result))

        def again() -> None:
            _overwrite(func, kept, func(*kept_args, **kept_kwargs))

        self._steps.append(Step(str(func), place(), given((args, kwargs)), again, kept))
        return result


class _Pretender(_Mode):
    """Compares the operators with the recorded ones, and returns what those did."""

    def __init__(self, comparer: Comparer) -> None:
        super().__init__()
        self._comparer = comparer

    def do(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        step = self._comparer(str(func), given((args, kwargs)))
        returns = func._schema.returns
        if any(value.alias_info is not None and not value.alias_info.is_write for value in returns):
            return func(*args, **kwargs)  # a view touches no numbers
        written = _written(func, args, kwargs)
        made = step.result if isinstance(step.result, tuple) and len(returns) > 1 else (step.result,)
        results = [
            _alias(new) if value.alias_info is None else written[frozenset(value.alias_info.before_set)]
            for value, new in zip(returns, made, strict=False)
        ]
        return tuple(results) if len(returns) > 1 else results[0] if returns else None


def _alias(value: Any) -> Any:
    """The same with tensors that share the memory, and are no part of autograd's graph."""
    return tree_map_only(Tensor, lambda tensor: tensor.detach(), value)


def _written(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[frozenset[str], Any]:
    """The arguments that an operator changes in place, by their marks in its schema."""
    found: dict[frozenset[str], Any] = {}
    for position, argument in enumerate(func._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            value = args[position] if position < len(args) else kwargs.get(argument.name)
            found[frozenset(argument.alias_info.before_set)] = value
    return found


def _overwrite(func: Any, recorded: Any, result: Any) -> None:
    """Put new results where the recorded ones lie; views, and what works in place, lie there already."""
    several = len(func._schema.returns) > 1
    for returned, old, new in zip(
        func._schema.returns, recorded if several else (recorded,), result if several else (result,), strict=False
    ):
        if returned.alias_info is None:
            _copy(old, new)


def _copy(old: Any, new: Any) -> None:
    if isinstance(old, Tensor):
        old.copy_(new)
    elif isinstance(old, (list, tuple)):
        for one, other in zip(old, new, strict=True):
            _copy(one, other)
