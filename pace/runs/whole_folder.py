"""A folder that is replaced as a whole: by one that is complete, or not at all, whenever the process is killed.

The new folder is made in a hidden one beside it. A lock in that tells whether the process that made it still lives;
what a dead one has left, the next replacement in the same place finishes or undoes.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from pace.runs.files import say

PREFIX, LOCK = ".pace_new_", ".pace_lock"
FRESH, OLD = "fresh", "old"  # in the hidden folder: the new one, in a folder of its own, and the one that it replaces


@contextmanager
def replaced(folder: Path) -> Iterator[Path]:
    """Replace ``folder`` by the one that the block makes at the path it gets; if the block fails, nothing changes.

    The new folder has the same name meanwhile. Errors: ``OSError``.
    """
    place = folder.resolve()
    place.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(dir=place.parent, prefix=PREFIX))
    lock = FileLock(scratch / LOCK)
    with suppress(OSError, NotImplementedError):  # a file system without locks: nobody will touch it
        lock.acquire(timeout=0)
    try:
        fresh = scratch / FRESH / place.name
        fresh.parent.mkdir()
        yield fresh
        if place.exists():
            place.rename(scratch / OLD)
        fresh.rename(place)
    finally:  # of Ctrl-C, too
        _settle(scratch)
        lock.release()


def clear_leftovers(parent: Path) -> None:
    """Remove what killed processes have left of :func:`replaced` in ``parent``. A folder that was to be replaced, and
    was not yet, gets its name back."""
    for scratch in sorted(parent.glob(f"{PREFIX}*")) if parent.is_dir() else ():
        with suppress(Timeout, OSError, NotImplementedError):  # in use, or of somebody else
            if _is_own(scratch):
                with FileLock(scratch / LOCK).acquire(timeout=0):
                    _settle(scratch)


def _is_own(scratch: Path) -> bool:
    """Whether a hidden folder is one of :func:`replaced`, and nobody has put anything else into it."""
    names = {entry.name for entry in scratch.iterdir()}
    return not scratch.is_symlink() and LOCK in names and names <= {LOCK, FRESH, OLD}


def _settle(scratch: Path) -> None:
    """Put the old folder back, unless the new one has taken its place, and remove the rest."""
    old, fresh = scratch / OLD, scratch / FRESH
    waiting = sorted(fresh.iterdir()) if fresh.is_dir() else []
    if old.exists() and waiting:
        place = scratch.with_name(waiting[0].name)
        if place.exists():
            say(f"warning: {old} was to be replaced when a command was killed, and {place} is a new one: both stay")
            return
        old.rename(place)
    shutil.rmtree(scratch, ignore_errors=True)
