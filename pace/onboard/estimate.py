"""An estimate: a quantity that the robot computes over an episode, one control step at a time."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import Any, NamedTuple

from torch import Tensor, nn


class Part(NamedTuple):
    """Columns of an estimate's state: how many, their unit and what they mean."""

    size: int
    unit: str
    meaning: str


class Estimate(nn.Module):
    """Base of the estimates: the state (N, ``size``) of each robot before a control step -> after it.

    An estimate is made of (its numbers, control_dt s, number of joints J). It has three methods:

    - :meth:`parts`, the columns of its state, in order;
    - ``begin(**signals)``: the state (N, ``size``) when an episode begins, from its first readings;
    - ``forward(state, **signals)``: the state after one more control step.

    The signals are those that its entry in :data:`pace.onboard.estimates.ESTIMATES` names, as keyword arguments. Both
    are pure: they write into no argument, read no value on the host and use operators that ONNX has.

    Attributes: ``config`` its numbers; ``control_dt`` s; ``columns`` part -> columns of the state; ``size``.
    """

    def __init__(self, config: Any, control_dt: float, joints: int) -> None:
        super().__init__()
        self.config, self.control_dt = config, control_dt
        self.columns = columns(self.parts(joints))
        self.size = max(where.stop for where in self.columns.values())

    @staticmethod
    def parts(joints: int) -> dict[str, Part]:
        """The state's parts by name, in the order of their columns, for a robot with so many joints."""
        raise NotImplementedError

    def begin(self, **signals: Tensor) -> Tensor:
        """The state at the start of an episode."""
        raise NotImplementedError


def columns(parts: Mapping[str, Part]) -> dict[str, slice]:
    """Columns of each part, concatenated."""
    ends = accumulate(part.size for part in parts.values())
    return {name: slice(end - part.size, end) for (name, part), end in zip(parts.items(), ends, strict=True)}
