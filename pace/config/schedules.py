"""Values and tasks that change during a run, by control steps or by shares of its plan."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

from omegaconf import MISSING

from pace.config.base import require

PLANNED = "planned"  # counter of a checkpoint: control steps of the plan, once it is fixed


class Position(NamedTuple):
    """How far a run has come: ``samples`` control steps, which are a ``share`` of its plan; 0 without a plan."""

    samples: float
    share: float = 0.0


START, END = Position(0.0), Position(math.inf, math.inf)


def position(samples: float, planned: float | None) -> Position:
    """Where a run of ``planned`` control steps is after ``samples``; None: not planned yet."""
    return Position(samples, samples / planned if planned else 0.0)


def position_of(counters: Mapping[str, float]) -> Position:
    """Where the run of a checkpoint is, by its counters."""
    return position(counters.get("samples", 0.0), counters.get(PLANNED))


@dataclass
class Begin:
    """A place in a run: after ``samples`` control steps, or after a ``share`` of the plan."""

    samples: float | None = None
    share: float | None = field(default=None, kw_only=True)

    @property
    def place(self) -> float:
        """The number of the one that is given."""
        given = self.samples if self.share is None else self.share
        assert given is not None  # checked when it was read
        return given

    def reached(self, at: Position) -> bool:
        """Whether a run at ``at`` has come here."""
        return self.place <= along(at, [self])


@dataclass
class SchedulePoint(Begin):
    """A value from ``samples`` or a ``share`` on; between points it is interpolated linearly."""

    value: float = MISSING


@dataclass
class Stage(Begin):
    """Changes of the task from ``samples`` or a ``share`` of a run on: overrides as ``sensing=wide``."""

    task: list[str] = MISSING


def along(at: Position, begins: Sequence[Begin]) -> float:
    """``at`` in the unit of ``begins``."""
    return at.share if in_shares(begins) else at.samples


def in_shares(begins: Sequence[Begin]) -> bool:
    """Whether ``begins``, checked, are shares of the plan."""
    return any(begin.share is not None for begin in begins)


def begin_in_words(begin: Begin) -> str:
    """``1e+06 control steps``, or ``30 % of the plan``."""
    return f"{begin.samples:g} control steps" if begin.share is None else f"{100 * begin.share:g} % of the plan"


def check_begins(name: str, begins: Sequence[Begin]) -> None:
    """Errors: :class:`ConfigError` unless all have ``samples``, or all have a ``share``."""
    for begin in begins:
        require(begin.samples is not None or begin.share is not None, f"{name}: each entry needs samples or share")
    given = {key for begin in begins for key in ("samples", "share") if getattr(begin, key) is not None}
    require(len(given) <= 1, f"{name}: give samples or share, not both in one schedule")


def scheduled(points: Sequence[SchedulePoint], at: Position) -> float:
    """Value of a schedule at a place in a run: linear between points, constant outside them."""
    ordered, now = sorted(points, key=lambda point: point.place), along(at, points)
    if now <= ordered[0].place:
        return ordered[0].value
    for low, high in pairwise(ordered):
        if now < high.place:
            share = (now - low.place) / (high.place - low.place)
            return low.value + share * (high.value - low.value)
    return ordered[-1].value
