"""The folders of a run's checkpoints: their names, and those that are found, pruned and cleaned by them.

Only names that a run writes count. What a user puts beside the checkpoints, or into them, is not touched.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from pace.config.base import printable
from pace.runs.files import reason

META, WEIGHTS, TRAINING = "checkpoint.json", "weights.safetensors", "training.safetensors"
FOLDER = "checkpoints"
FILES = (META, WEIGHTS, TRAINING)
NAME = re.compile(r"update_(\d{8,})")  # of the folders that a run writes; others beside them are the user's
LAST_GOOD = "last_good"  # folder in a run: the weights before an update that failed
LEFTOVER = re.compile(rf"\.(update_\d{{8,}}|{LAST_GOOD})\.\d+\.(tmp|old)")  # of a kill while a checkpoint was written


class CheckpointError(RuntimeError):
    """A checkpoint that cannot be found, read or used; the message, in one line, names the file and the reason."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


def find_checkpoint(path: str | Path) -> Path:
    """Folder of the checkpoint that ``path`` means: a run folder (its newest), a checkpoint folder, or a file in one.

    Errors: :class:`CheckpointError` when there is none.
    """
    try:
        return _find(Path(path))
    except (OSError, ValueError) as error:  # no permission; a name that is too long, or has a zero byte
        raise CheckpointError(f"{path} cannot be read: {reason(error)}") from error


def _find(path: Path) -> Path:
    if path.is_file():
        path = path.parent
    if not path.exists():
        raise CheckpointError(f"{path} does not exist: give a run folder or a checkpoint")
    if (path / META).is_file():
        return path
    if (path / FOLDER).is_dir():
        found = list_checkpoints(path)
        if found:
            return found[-1]
        others = ", ".join(other.name for other in _entries(path / FOLDER) if (other / META).is_file())
        named = f"; {FOLDER}/ holds {others}: name one of them" if others else ""
        raise CheckpointError(f"{path} is a run folder without a checkpoint{named}")
    raise CheckpointError(f"{path} is neither a run folder nor a checkpoint: it has no {FOLDER}/ and no {META}")


def list_checkpoints(run: Path) -> list[Path]:
    """Complete checkpoints that a run has written, oldest first. Copies beside them, of other names, are the user's."""
    there = (folder for folder in _entries(run / FOLDER) if NAME.fullmatch(folder.name))
    return sorted((folder for folder in there if (folder / META).is_file()), key=update_of)


def update_of(checkpoint: Path) -> int:
    """The update at which a run has written ``checkpoint``, by its name."""
    name = NAME.fullmatch(checkpoint.name)
    assert name is not None  # of a run
    return int(name[1])


def clear_leftovers(run: Path) -> None:
    """Remove what a kill has left of checkpoints that were being written. The caller owns the run."""
    for folder in (path for place in (run, run / FOLDER) for path in _entries(place)):
        left = LEFTOVER.fullmatch(folder.name)
        if left is None or folder.is_symlink() or not holds_nothing_else(folder):
            continue
        if left[2] == "old" and not folder.with_name(left[1]).exists():
            folder.rename(folder.with_name(left[1]))
        else:
            shutil.rmtree(folder)


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def holds_nothing_else(folder: Path) -> bool:
    """Whether a folder has the files of a checkpoint, or some of them, and nothing that a user has put there."""
    return folder.is_dir() and all(file.name in FILES for file in folder.iterdir())


def prune_checkpoints(run: Path, keep: int) -> None:
    """Delete all but the newest ``keep`` checkpoints of a run; not one that is a link, or to which files were added."""
    for folder in list_checkpoints(run)[:-keep]:
        if not folder.is_symlink() and holds_nothing_else(folder):
            shutil.rmtree(folder, ignore_errors=True)
