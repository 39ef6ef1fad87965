"""A GPU's way on a CPU, as the reference of a replay: calls that would be captured run each time as they are."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from torch import Tensor

from pace.arrays import graph


class Unreplayed:
    """In place of a :class:`pace.arrays.dry.Recording`: the function itself."""

    def __init__(self, function: Callable[..., None], inputs: tuple[Tensor, ...]) -> None:
        self._function, self._inputs = function, inputs

    def replay(self) -> None:
        self._function(*self._inputs)


def without_replay(patch: pytest.MonkeyPatch) -> None:
    """From now on nothing is recorded under ``engine.graph=dry``; the way through the code is the same."""
    patch.setattr(graph, "Recording", Unreplayed)
