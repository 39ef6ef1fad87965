"""The rows of a run as they are written: ``metrics.csv`` and the events of TensorBoard."""

from __future__ import annotations

import csv
import io
import math
import os
import socket
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog  # type: ignore[attr-defined]
from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[attr-defined]
from tensorboard.summary.writer.record_writer import RecordWriter

from pace.runs.files import AppendFile, write_whole

LEADING = (
    "update", "samples", "wall_s", "samples_per_s", "hit_rate", "success_rate", "fall_rate", "predictor_rmse_cm",
    "mean_reward", "kl", "lr", "policy_std", "eval_hit", "eval_success",
)  # fmt: skip
EVENTS_VERSION = "brain.Event:2"  # what readers of TensorBoard's files expect in their first event
FIRST_COLUMN = "update,"  # begins a metrics.csv


class MetricsFile:
    """``metrics.csv``: one row per update, the columns of the first one. Rows after ``first_update`` are dropped.

    Errors: ``OSError`` if what is there cannot be read, or replaced.
    """

    def __init__(self, path: Path, first_update: int) -> None:
        self._columns: list[str] = []
        #: Control steps of the last row that is kept; 0 without one.
        self.samples = 0
        if path.exists():
            self._take_over(path, first_update)
        self._file = AppendFile(path, self._head)

    def _take_over(self, path: Path, first_update: int) -> None:
        """Keep the rows up to ``first_update``; the file is replaced if that changes it."""
        text = path.read_text(encoding="utf-8", errors="replace")
        self._columns, rows = read_rows(text)
        kept = [row for row in rows if int(row["update"]) <= first_update]
        if kept and kept[-1].get("samples", "").isdigit():
            self.samples = int(kept[-1]["samples"])
        fresh = "".join(map(_line, [self._columns, *(row.values() for row in kept)])) if self._columns else ""
        if fresh != text:
            write_whole(path, fresh)

    def _head(self) -> bytes:
        return _line(self._columns).encode()

    def add(self, row: Mapping[str, float]) -> None:
        """Append one row. NaN is an empty cell."""
        if not self._columns:
            self._columns = [*LEADING, *(name for name in row if name not in LEADING)]
        self._file.add(_line([_cell(row.get(name, math.nan)) for name in self._columns]).encode())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_rows(text: str) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a ``metrics.csv``.

    Left out: cells beyond the columns, and what is no row of an update, such as one that a lost disk has cut.
    """
    lines = text.replace("\0", "").splitlines()
    cells = [line.split(",") for line in lines]
    columns = cells[0] if lines and lines[0].startswith(FIRST_COLUMN) else []
    whole = (row for row in cells[1:] if len(row) >= len(columns) and row[0].isdigit())
    return columns, [dict(zip(columns, row, strict=False)) for row in whole] if columns else []


def _line(cells: Iterable[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


def _cell(value: float) -> str:
    if math.isnan(value):
        return ""
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else f"{value:.6g}"


class EventsFile:
    """A file of events in ``folder``, for TensorBoard.

    Readers then forget what other files there hold from ``first_sample`` on: a run that resumes writes it again.
    """

    def __init__(self, folder: Path, first_sample: int) -> None:
        name = f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.{os.getpid()}"
        self._file = AppendFile(folder / name)
        self._add(Event(wall_time=time.time(), step=first_sample, file_version=EVENTS_VERSION))
        self._add(Event(wall_time=time.time(), step=first_sample, session_log=SessionLog(status=SessionLog.START)))

    def add(self, row: Mapping[str, float]) -> None:
        """Append one row, at its ``samples``."""
        values = [Summary.Value(tag=name, simple_value=value) for name, value in row.items() if not math.isnan(value)]
        self._add(Event(wall_time=time.time(), step=int(row["samples"]), summary=Summary(value=values)))

    def _add(self, event: Event) -> None:
        record = _Record()
        RecordWriter(record).write(event.SerializeToString())
        self._file.add(b"".join(record.parts))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class _Record:
    """What a RecordWriter writes, in memory."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []

    def write(self, part: bytes) -> None:
        self.parts.append(part)
