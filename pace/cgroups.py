"""The control groups that this process is in, by which containers and job schedulers limit it. Imports no torch."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PROCESS = Path("/proc/self")  # of Linux: the control groups of this process, and where they are mounted


class Group(NamedTuple):
    """A control group: the version (1 or 2) of its tree, and its folder."""

    version: int
    folder: Path


class Hierarchy(NamedTuple):
    """A mounted tree of control groups: its version (1 or 2), where it is mounted, and the group at that place."""

    version: int
    mount: Path
    root: str


def groups_of(controller: str, process: Path = PROCESS) -> Iterator[Group]:
    """The groups of a process that ``controller`` (cpu, memory) may limit, from its own to the outermost that it sees.

    A group that is not below the mounted one counts as that. None where the system does not tell.
    """
    try:
        mounts = (process / "mountinfo").read_text(encoding="utf-8")
        groups = (process / "cgroup").read_text(encoding="utf-8")
    except OSError:
        return
    for tree in _hierarchies(mounts, controller):
        inside = os.path.relpath(_own(tree.version, groups, controller), tree.root)
        place = tree.mount if inside.startswith("..") else tree.mount / inside
        while True:
            yield Group(tree.version, place)
            if place in (tree.mount, place.parent):
                break
            place = place.parent


def _hierarchies(mounts: str, controller: str) -> Iterator[Hierarchy]:
    """Trees of control groups that may have the controller, of the lines of ``mountinfo``."""
    for line in mounts.splitlines():
        left, _, right = line.partition(" - ")
        place, kind = left.split(), right.split()
        if len(place) < 5 or len(kind) < 3 or kind[0] not in ("cgroup", "cgroup2"):
            continue
        if kind[0] == "cgroup2" or controller in kind[2].split(","):
            yield Hierarchy(2 if kind[0] == "cgroup2" else 1, Path(_plain(place[4])), _plain(place[3]))


def _plain(escaped: str) -> str:
    """A path of ``mountinfo``, which has spaces as octal numbers."""
    return re.sub(r"\\([0-7]{3})", lambda code: chr(int(code[1], 8)), escaped)


def _own(version: int, groups: str, controller: str) -> str:
    """This process's group in the tree of that version, of the lines of ``cgroup``."""
    for line in groups.splitlines():
        number, controllers, path = line.split(":", 2)
        if (version == 2 and number == "0") or (version == 1 and controller in controllers.split(",")):
            return path
    return "/"
