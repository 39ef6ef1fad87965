"""The memory that this process may still take, of what the machine has. Imports no torch."""

from __future__ import annotations

import math
from pathlib import Path

from pace.cgroups import PROCESS, Group, groups_of

MACHINE = Path("/proc/meminfo")  # of Linux
GIB = 2**30
UNLIMITED = 2**60  # bytes: groups of version 1 have a number near 2^63 for no limit
#: Of a group, by version: the files of its limit, and the name of what its processes hold (without the cache of files).
FILES = {1: ("memory.limit_in_bytes", "total_rss"), 2: ("memory.max", "anon")}


def available_memory(process: Path = PROCESS, machine: Path = MACHINE) -> float:
    """GiB that this process and those that it starts can take before the system, or a control group, kills one.

    Infinite where the system does not tell.
    """
    free = [_left(group) for group in groups_of("memory", process)]
    try:
        lines = (line.split() for line in machine.read_text(encoding="utf-8").splitlines())
        free += [1024.0 * float(line[1]) for line in lines if line[0] == "MemAvailable:"]
    except OSError:
        pass
    return min(free, default=math.inf) / GIB


def _left(group: Group) -> float:
    """Bytes that a group has left; infinite without a limit."""
    limit_file, held_name = FILES[group.version]
    try:
        limit = (group.folder / limit_file).read_text(encoding="utf-8").strip()
        rows = (group.folder / "memory.stat").read_text(encoding="utf-8").splitlines()
        held = dict(row.split() for row in rows)
        if limit == "max" or int(limit) >= UNLIMITED:
            return math.inf
        return max(0.0, float(limit) - float(held[held_name]))
    except (OSError, ValueError, KeyError):
        return math.inf  # the controller is not switched on here
