"""Moving averages of a run's metrics, and the milestones of standing, hitting and returning that they pass."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pace.runs.files import write_whole

Array = NDArray[np.float64]

WINDOW = 250_000.0  # control steps that a point of a curve averages over: a thousand serves and more
#: A rate of a curve -> its column in ``metrics.csv``: shares of the serves, and falls per second of a world's time.
RATES = {"hits": "hit_rate", "returns": "success_rate", "falls": "fall_rate"}
#: Columns of ``metrics.csv`` in a slim CSV.
SLIM_COLUMNS = (
    "update", "samples", "wall_s", "hit_rate", "success_rate", "fall_rate", "serves", "predictor_rmse_cm",
    "mean_reward", "kl", "lr", "policy_std",
)  # fmt: skip
LONGEST_ROW = 16_384  # letters of a row of ``metrics.csv``, at most
SLIM_ROWS = 4  # rows of ``metrics.csv`` in one of a slim CSV
_LAST = ("update", "samples", "wall_s")  # totals since the start of a run: a slim row has the last value
_SHARES = ("hit_rate", "success_rate")  # of the serves of a row


@dataclass(frozen=True)
class Milestone:
    """A value that one of :data:`RATES` passes: falls come down to it, the others rise to it."""

    rate: str
    value: float

    @property
    def label(self) -> str:
        """In words."""
        if self.rate != "falls":
            return f"{self.rate} {100 * self.value:.0f} %"
        return "falls < 1/3 /s" if self.value == 1 / 3 else f"falls < {self.value:g} /s"


MILESTONES = (
    *(Milestone("falls", value) for value in (1 / 3, 0.1)),
    *(Milestone("hits", value) for value in (0.1, 0.5, 0.9)),
    *(Milestone("returns", value) for value in (0.1, 0.5, 0.8)),
)


@dataclass(frozen=True)
class Curve:
    """Moving averages of a run, arrays (M,): ``samples`` in control steps, ``minutes`` of the clock, ``rates`` by name.

    Points whose window is not full are left out; a rate is NaN if nothing was counted in the window.
    """

    samples: Array
    minutes: Array
    rates: Mapping[str, Array]


@dataclass(frozen=True)
class Passage:
    """The point at which a curve first passes a milestone; ``at_start``: its first point is already beyond."""

    samples: float
    minutes: float
    at_start: bool


def read_metrics(file: str | Path, columns: Iterable[str] | None = None) -> dict[str, list[float]]:
    """Columns of a ``metrics.csv``, all or those of ``columns`` that it has; an empty cell is NaN."""
    with Path(file).open(encoding="utf-8", newline="", errors="replace") as handle:
        rows = list(csv.DictReader(handle))
    head = [name for name in (rows[0] if rows else ()) if name is not None]  # None: cells beyond the columns
    names = [name for name in head if columns is None or name in set(columns)]
    return {name: [_number(row[name]) for row in rows] for name in names}


def last_row(file: Path) -> dict[str, float]:
    """The last whole row of a ``metrics.csv`` that may still grow; empty if there is none."""
    try:
        with file.open("rb") as handle:
            head = handle.readline()
            handle.seek(max(len(head), handle.seek(0, os.SEEK_END) - LONGEST_ROW))
            *rows, _ = handle.read().decode(errors="replace").split("\n")  # the end of the last row may be missing
    except OSError:
        return {}
    names, cells = head.decode(errors="replace").strip().split(","), rows[-1].split(",") if rows else []
    return {name: _number(cell) for name, cell in zip(names, cells, strict=True)} if len(names) == len(cells) else {}


def _number(cell: str | None) -> float:
    """A cell's value; NaN for an empty one, and for one that a full disk or an editor has cut."""
    try:
        return float(cell or "nan")
    except ValueError:
        return math.nan


def read_curve(file: str | Path, window: float = WINDOW, columns: Mapping[str, str] = RATES) -> Curve:
    """The curve of a ``metrics.csv``, whole or slim, averaged over the last ``window`` control steps.

    Shares are weighted by the serves of their rows if the file has them. ``columns``: names of the rates in it.
    """
    wanted = ("samples", "wall_s", "serves", *columns.values())
    metrics = {name: np.array(values) for name, values in read_metrics(file, wanted).items()}
    if not metrics:
        return Curve(np.zeros(0), np.zeros(0), {rate: np.zeros(0) for rate in columns})
    samples, steps = metrics["samples"], np.ones(len(metrics["samples"]))
    full = _full_windows(samples, window)
    rates = {}
    for rate, column in columns.items():
        weight = steps if rate == "falls" else metrics.get("serves", steps)
        rates[rate] = _moving_mean(samples, metrics[column], weight, window)[full]
    return Curve(samples[full], metrics["wall_s"][full] / 60.0, rates)


def _full_windows(samples: Array, window: float) -> NDArray[np.bool_]:
    """Start of each row in control steps; the first row is taken to be as long as the second."""
    if len(samples) < 2:
        return np.zeros(len(samples), dtype=bool)
    began = 2.0 * samples[0] - samples[1]
    return samples - began >= window


def _moving_mean(samples: Array, values: Array, weight: Array, window: float) -> Array:
    """Weighted mean of ``values`` over the rows within the last ``window`` control steps; NaN without weight."""
    weight = np.where(np.isnan(values), 0.0, weight)
    first = np.searchsorted(samples, samples - window, side="right")
    end = np.arange(1, len(samples) + 1)

    def windowed(summands: Array) -> Array:
        total = np.concatenate([[0.0], np.cumsum(summands)])
        return total[end] - total[first]

    weights, sums = windowed(weight), windowed(np.nan_to_num(values) * weight)
    return np.divide(sums, weights, out=np.full(len(samples), np.nan), where=weights > 0)


def passage(curve: Curve, milestone: Milestone) -> Passage | None:
    """The point at which ``curve`` first passes ``milestone``; None if it never does.

    For falls, points before the maximum do not count: robots that were just reset have not fallen yet.
    """
    rate = curve.rates[milestone.rate]
    if not np.isfinite(rate).any():
        return None
    if milestone.rate == "falls":
        passed = rate < milestone.value
        worst = int(np.nanargmax(rate))
        if not passed[worst]:
            passed[:worst] = False
    else:
        passed = rate >= milestone.value
    if not passed.any():
        return None
    first = int(passed.argmax())
    return Passage(float(curve.samples[first]), float(curve.minutes[first]), first == 0)


def passage_text(found: Passage | None) -> str:
    """Millions of control steps and, in brackets, minutes; a dash for a milestone that was not reached."""
    if found is None:
        return "-"
    if found.at_start:
        return "from the start"
    return f"{found.samples / 1e6:.1f} ({found.minutes:.0f})"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def write_slim(source: str | Path, target: str | Path, every: int = SLIM_ROWS) -> Path:
    """Write the :data:`SLIM_COLUMNS` that ``source`` has, ``every`` rows pooled into one, so that no serve is lost."""
    metrics = read_metrics(source, SLIM_COLUMNS)
    names = [name for name in SLIM_COLUMNS if name in metrics]
    count = len(metrics.get("samples", ()))
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(names)
    for start in range(0, count, every):
        block = {name: np.array(metrics[name][start : start + every]) for name in names}
        writer.writerow(f"{_pooled(name, block):.8g}".replace("nan", "") for name in names)
    write_whole(Path(target), text.getvalue())
    return Path(target)


def _pooled(name: str, block: Mapping[str, Array]) -> float:
    """One value for the rows of ``block``."""
    values = block[name]
    if name in _LAST:
        return float(values[-1])
    if name == "serves":
        return float(values.sum())
    weight = block["serves"] if name in _SHARES and "serves" in block else np.ones(len(values))
    weight = np.where(np.isnan(values), 0.0, weight)
    return float(np.nansum(values * weight) / weight.sum()) if weight.sum() > 0 else float("nan")
