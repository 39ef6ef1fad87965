"""The processor cores that this process may use, of those that the machine has. Imports no torch."""

from __future__ import annotations

import os
from pathlib import Path

from pace.cgroups import PROCESS, Group, groups_of


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
    found = [share for share in map(_share, groups_of("cpu", process)) if share is not None]
    return min(found, default=None)


def _share(group: Group) -> float | None:
    """The limit of one group, in cores."""
    try:
        if group.version == 2:
            granted, period = (group.folder / "cpu.max").read_text(encoding="utf-8").split()
        else:
            granted, period = (
                (group.folder / f"cpu.cfs_{name}_us").read_text(encoding="utf-8").strip()
                for name in ("quota", "period")
            )
        return None if granted in ("max", "-1") else float(granted) / float(period)
    except (OSError, ValueError, ZeroDivisionError):
        return None  # no such file: the controller is not switched on here
