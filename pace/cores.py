"""The processor cores that this process may use, of those that the machine has. Imports no torch."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PROCESS = Path("/proc/self")  # of Linux: the control groups of this process, and where they are mounted


class Hierarchy(NamedTuple):
    """A mounted tree of control groups: its version (1 or 2), where it is mounted, and the group at that place."""

    version: int
    mount: Path
    root: str


def usable_cores() -> int:
    """Cores for threads and processes: those of the CPU set, no more than the quota of the control groups grants.

    A container with ``--cpus=2`` and a job with a share of a machine see all of its cores, and are paused when they use
    more than their quota.
    """
    allowed = len(core_set()) or os.cpu_count() or 1
    granted = quota()
    return allowed if granted is None else max(1, min(allowed, int(granted)))


def core_set() -> list[int]:
    """Numbers of the cores that the scheduler may give to this process; none if the system does not tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def threads_of(size: int) -> int:
    """Threads for each of ``size`` processes on this machine."""
    return max(1, usable_cores() // size)


def quota(process: Path = PROCESS) -> float | None:
    """Processor seconds per second that the control groups of this process grant; None: no limit, or not known."""
    try:
        mounts = (process / "mountinfo").read_text(encoding="utf-8")
        groups = (process / "cgroup").read_text(encoding="utf-8")
    except OSError:
        return None
    found = [share for tree in _hierarchies(mounts) for share in _shares(tree, _group(tree.version, groups))]
    return min(found, default=None)


def _hierarchies(mounts: str) -> Iterator[Hierarchy]:
    """Trees of control groups that may limit processor time, of the lines of ``mountinfo``."""
    for line in mounts.splitlines():
        left, _, right = line.partition(" - ")
        place, kind = left.split(), right.split()
        if len(place) < 5 or len(kind) < 3 or kind[0] not in ("cgroup", "cgroup2"):
            continue
        if kind[0] == "cgroup2" or "cpu" in kind[2].split(","):
            yield Hierarchy(2 if kind[0] == "cgroup2" else 1, Path(_plain(place[4])), _plain(place[3]))


def _plain(escaped: str) -> str:
    """A path of ``mountinfo``, which has spaces as octal numbers."""
    return re.sub(r"\\([0-7]{3})", lambda code: chr(int(code[1], 8)), escaped)


def _group(version: int, groups: str) -> str:
    """This process's group in the tree of that version, of the lines of ``cgroup``."""
    for line in groups.splitlines():
        number, controllers, path = line.split(":", 2)
        if (version == 2 and number == "0") or (version == 1 and "cpu" in controllers.split(",")):
            return path
    return "/"


def _shares(tree: Hierarchy, group: str) -> Iterator[float]:
    """The limits of a group and of those around it. A group that is not below the mounted one counts as that."""
    inside = os.path.relpath(group, tree.root)
    place = tree.mount if inside.startswith("..") else tree.mount / inside
    while True:
        share = _share(tree.version, place)
        if share is not None:
            yield share
        if place == tree.mount or place == place.parent:
            return
        place = place.parent


def _share(version: int, group: Path) -> float | None:
    """The limit of one group, in cores."""
    try:
        if version == 2:
            granted, period = (group / "cpu.max").read_text(encoding="utf-8").split()
        else:
            granted, period = (
                (group / f"cpu.cfs_{name}_us").read_text(encoding="utf-8").strip() for name in ("quota", "period")
            )
        return None if granted in ("max", "-1") else float(granted) / float(period)
    except (OSError, ValueError, ZeroDivisionError):
        return None  # no such file: the controller is not switched on here
