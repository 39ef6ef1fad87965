"""Control groups of this machine, of both versions, for tests of limits by doing. Linux, as root."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

ROOT = Path("/sys/fs/cgroup")


def place_of(version: int, controller: str) -> Path:
    """The folder whose groups ``controller`` can limit. Skips the test where there is none."""
    if version == 1:
        place = ROOT / controller
        if not (place / "tasks").exists():
            pytest.skip(f"no control groups of version 1 for {controller}")
        return place
    place = ROOT if (ROOT / "cgroup.controllers").exists() else ROOT / "unified"
    granted = place / "cgroup.subtree_control"
    if not granted.exists() or controller not in granted.read_text().split():
        pytest.skip(f"{place} (control groups of version 2) grants no {controller} to groups below it")
    return place


@contextmanager
def control_group(version: int, controller: str, values: Mapping[str, str]) -> Iterator[Path]:
    """A new group with ``values`` in its files, while the block runs: a process enters by its cgroup.procs."""
    group = place_of(version, controller) / f"pace_test_{os.getpid()}"
    with ExitStack() as made:
        try:
            group.mkdir()
            made.callback(group.rmdir)
            for name, value in values.items():
                (group / name).write_text(value)
        except OSError as error:
            pytest.skip(f"this machine lets no test make control groups: {error}")
        yield group
