"""Publishing a policy: a folder small enough for a repository, with the policy, its training and its evaluation.

It holds the weights (float32) and the configuration of a run's newest checkpoint, or of a checkpoint, and the training
state only if that is asked for; beside them the main columns of the run's metrics, its learning curve, the tables and
figures of an evaluation and of a sweep, and a model card (README.md).
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from omegaconf import DictConfig

from pace.config.base import parse
from pace.config.commands import KeepConfig
from pace.evaluation.card import CARD, FIRST_ROW, card
from pace.rl.policies import locate
from pace.runs.checkpoint import META, TRAINING, WEIGHTS, CheckpointError, export_weights, find_checkpoint
from pace.runs.checkpoint_folders import FOLDER
from pace.runs.files import write_whole
from pace.runs.metrics import write_slim
from pace.runs.own_files import LIST, listed, note
from pace.runs.own_files import require_own as require_own_files
from pace.runs.run_folder import METRICS
from pace.runs.whole_folder import clear_leftovers, replaced

RUN_FILES = ("learning_curve.png", "versions.json")
EVALUATION_FILES = ("evaluation.json", "evaluation.md", "evaluation.csv")
EVALUATION_FILES += ("strike_map.png", "landing_map.png", "by_ball.png")
SWEEP_FILES = ("sweep.json", "sweep.png")
#: All files that this module writes into a folder; it leaves other files alone.
FILES = (META, WEIGHTS, TRAINING, METRICS, CARD, *RUN_FILES, *EVALUATION_FILES, *SWEEP_FILES)


class KeepError(RuntimeError):
    """A policy that cannot be published there; the message says why, and nothing was changed."""


def keep_from_config(composed: DictConfig) -> None:
    """Publish as configured, and print the files."""
    config = parse(composed, KeepConfig)
    assert config.run is not None  # guaranteed by KeepConfig
    assert config.out is not None
    try:
        notes = Path(config.notes).read_text(encoding="utf-8") if config.notes else ""
        evaluation = Path(config.evaluation) if config.evaluation else None
        files = keep(locate(config.run), Path(config.out), evaluation, notes, config.training)
    except (OSError, UnicodeDecodeError) as error:
        raise KeepError(str(error)) from error
    for file in files:
        print(f"wrote {file} ({file.stat().st_size / 1024:.0f} KiB)")


def keep(
    run: Path, folder: Path, evaluation: Path | None = None, notes: str = "", training: bool = False
) -> list[Path]:
    """Publish ``run`` and its ``evaluation`` as ``folder``, with ``notes`` in the card; returns the files written.

    With ``training`` the run can be resumed from the folder, on any machine, in worlds that start from scratch.

    The folder appears when it is complete. An existing published policy is replaced; files in it that this function
    did not write stay. What a kill has left of an earlier call beside ``folder`` is finished or undone.

    Errors: :class:`CheckpointError` for a ``run`` without a checkpoint, or an ``evaluation`` folder without results;
    :class:`KeepError` for a folder that holds anything else, or the run.
    """
    clear_leftovers(folder.parent)
    checkpoint = find_checkpoint(run)
    if evaluation is not None and not (evaluation / "evaluation.json").is_file():
        raise CheckpointError(f"{evaluation} holds no evaluation.json: give a folder that pace evaluate wrote")
    require_own(folder, run, checkpoint)
    with replaced(folder) as fresh:  # the card is headed by its name
        written = write_policy(fresh, checkpoint, evaluation, notes, training)
        if folder.is_dir():
            copy_others(folder, fresh)
    return [folder / name for name in written]


def require_own(folder: Path, run: Path, checkpoint: Path) -> None:
    """Errors: :class:`KeepError` unless ``folder`` is new, empty or a published policy, and does not hold the run."""
    place = folder.resolve()
    if any(path.resolve().is_relative_to(place) for path in (run, checkpoint)):
        raise KeepError(f"{folder} holds the run itself: give another folder, such as pretrained/mine")
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise KeepError(f"{folder} is no folder: give a new one, such as pretrained/mine")
    if folder.is_dir() and any(folder.iterdir()) and not is_published(folder):
        raise KeepError(f"{folder} holds other files, which are not replaced: give a new folder, such as {folder}/mine")
    if CARD in listed(folder):
        require_own_files(folder, FILES)


def is_published(folder: Path) -> bool:
    """Whether this module wrote ``folder``, by its list of files; of before there was one, by the card and a
    checkpoint that has weights only."""
    if {CARD, META, WEIGHTS} <= listed(folder):
        return True
    if not all((folder / name).is_file() for name in (CARD, META, WEIGHTS)):
        return False
    try:
        meta = json.loads((folder / META).read_text(encoding="utf-8"))
        text = (folder / CARD).read_text(encoding="utf-8")
    except ValueError:
        return False
    if FIRST_ROW not in text:
        return False
    return isinstance(meta, dict) and "config" in meta and meta.get("training") is None


def write_policy(folder: Path, checkpoint: Path, evaluation: Path | None, notes: str, training: bool) -> list[str]:
    """Write all files of a published policy into the new ``folder``; returns their names."""
    export_weights(checkpoint, folder, training)
    of_a_run = checkpoint.parent.name == FOLDER  # else of a published policy, whose metrics are short already
    run = checkpoint.parent.parent if of_a_run else checkpoint
    sources = [run / name for name in RUN_FILES]
    sources += [evaluation / name for name in EVALUATION_FILES + SWEEP_FILES] if evaluation is not None else []
    for source in sources:
        if source.is_file():
            shutil.copyfile(source, folder / source.name)
    if (run / METRICS).is_file():
        (write_slim if of_a_run else shutil.copyfile)(run / METRICS, folder / METRICS)
    write_whole(folder / CARD, card(folder, notes))
    names = sorted(file.name for file in folder.iterdir())
    note(folder, names)
    return names


def copy_others(old: Path, fresh: Path) -> None:
    """Copy the files of ``old`` that are not of this module into ``fresh``, with what its list says of them."""
    others = listed(old).difference(FILES)
    if others:
        note(fresh, sorted(others))
    for entry in old.iterdir():
        if entry.name in (*FILES, LIST):
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.copytree(entry, fresh / entry.name, symlinks=True)
        else:
            shutil.copy2(entry, fresh / entry.name, follow_symlinks=False)
