"""The steps of a recorded call, and their comparison with those of a later one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from pace.arrays.watch import DryRunError, place


class Memory(NamedTuple):
    """Where a tensor or an array of Warp lies, and how."""

    address: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    dtype: Any


class Step(NamedTuple):
    """An operator of torch, or a launch, copy or fill of Warp."""

    name: str
    place: str  # file and line
    given: Any  # arguments: numbers as they are, tensors and arrays by their memory
    again: Callable[[], object]  # does it once more, with what it was given
    result: Any = None  # tensors that it made


def given(value: Any) -> Any:
    """Arguments of a step, to be compared: each tensor and array by its memory, the others as they are."""
    if isinstance(value, Tensor):
        return Memory(value.data_ptr(), tuple(value.shape), value.stride(), value.dtype)
    if isinstance(value, wp.array):
        return Memory(value.ptr or 0, value.shape, value.strides, value.dtype)
    if isinstance(value, (list, tuple)):
        return tuple(given(item) for item in value)
    if isinstance(value, Mapping):
        return {name: given(item) for name, item in value.items()}
    return value


def difference(recorded: Any, other: Any) -> str | None:
    """What the arguments ``other`` have that the ``recorded`` ones do not, in words; None if they are the same."""
    if isinstance(recorded, Memory) and isinstance(other, Memory):
        if recorded[1:] != other[1:]:
            return f"a tensor of {_layout(other)} in place of one of {_layout(recorded)}"
        return None if recorded == other else f"another tensor of {_layout(other)} than in the recorded call"
    if isinstance(recorded, tuple) and isinstance(other, tuple) and len(recorded) == len(other):
        return next((found for pair in zip(recorded, other, strict=True) if (found := difference(*pair))), None)
    if isinstance(recorded, dict) and isinstance(other, dict) and recorded.keys() == other.keys():
        differences = {name: difference(value, other[name]) for name, value in recorded.items()}
        return next((f"{found} as '{name}'" for name, found in differences.items() if found), None)
    same = type(recorded) is type(other) and (recorded == other or (recorded != recorded and other != other))
    return None if same else f"{_in_words(other)} in place of {_in_words(recorded)}"


def _layout(memory: Memory) -> str:
    return f"shape {memory.shape}, {memory.dtype}"


def _in_words(value: Any) -> str:
    if isinstance(value, bytes):
        return "other memory or numbers"
    return f"another {type(value).__name__}" if isinstance(value, torch.Generator) else repr(value)


class Comparer:
    """Goes through recorded steps, and compares others with them."""

    def __init__(self, steps: list[Step]) -> None:
        self._steps, self._next = steps, 0

    def __call__(self, name: str, arguments: Any) -> Step:
        """The recorded step in this place. Errors: :class:`DryRunError` if it is another one."""
        if self._next >= len(self._steps):
            raise DryRunError(f"{place()}: {name} comes after the last step of the recorded call")
        step = self._steps[self._next]
        if step.name != name:
            raise DryRunError(f"{place()}: {name} comes where {step.name} of {step.place} was recorded")
        found = difference(step.given, arguments)
        if found is not None:
            raise DryRunError(f"{place()}: {name} is given {found}")
        self._next += 1
        return step

    def finish(self) -> None:
        """Errors: :class:`DryRunError` if steps are missing."""
        if self._next < len(self._steps):
            step = self._steps[self._next]
            raise DryRunError(f"{step.place}: {step.name} was recorded, and does not come in a later call")
