"""``python -m pace.evaluation.keep RUN FOLDER``: a policy to keep, small enough for the repository.

Writes weights (float32) and configuration of a run's newest checkpoint, or of a checkpoint, without its training
state; beside them the main columns of the run's metrics, its learning curve, the tables and figures of an evaluation
and of a sweep, and a card (README.md) that says what it all is.

    python -m pace.evaluation.keep runs/my_run pretrained/pace --evaluation runs/my_evaluation --notes notes.md
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from pace.evaluation.card import CARD, card
from pace.runs.checkpoint import CheckpointError, export_weights, find_checkpoint
from pace.runs.metrics import write_slim
from pace.runs.run_folder import METRICS

RUN_FILES = ("learning_curve.png", "versions.json")
EVALUATION_FILES = ("evaluation.json", "evaluation.md", "evaluation.csv", "strike_map.png", "landing_map.png")
SWEEP_FILES = ("sweep.json", "sweep.png")


def keep(run: Path, folder: Path, evaluation: Path | None = None, notes: str = "") -> list[Path]:
    """Write what is worth keeping of ``run`` and ``evaluation`` into ``folder``, and a card with ``notes``; returns the
    files.

    Errors: :class:`CheckpointError` for a folder that is no run, or that holds no evaluation.
    """
    if evaluation is not None and not (evaluation / "evaluation.json").is_file():
        raise CheckpointError(
            f"{evaluation} holds no evaluation.json: give a folder that pace.evaluation.__main__ wrote"
        )
    checkpoint = find_checkpoint(run)
    export_weights(checkpoint, folder)
    run_folder = checkpoint.parent.parent
    copies = [run_folder / name for name in RUN_FILES]
    copies += [evaluation / name for name in EVALUATION_FILES + SWEEP_FILES] if evaluation is not None else []
    for source in copies:
        if source.is_file():
            shutil.copyfile(source, folder / source.name)
    if (run_folder / METRICS).is_file():
        write_slim(run_folder / METRICS, folder / METRICS)
    (folder / CARD).write_text(card(folder, notes))
    return sorted(folder.iterdir())


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m pace.evaluation.keep", description=(__doc__ or "").split("\n\n")[1]
    )
    parser.add_argument("run", type=Path, help="run folder (its newest checkpoint counts) or checkpoint")
    parser.add_argument("folder", type=Path, help="where to write, such as pretrained/pace; an old one is replaced")
    parser.add_argument("--evaluation", type=Path, help="folder that pace.evaluation.__main__ wrote")
    parser.add_argument("--notes", type=Path, help="Markdown file whose text stands in the card")
    options = parser.parse_args(arguments)
    try:
        notes = options.notes.read_text() if options.notes else ""
        files = keep(options.run, options.folder, options.evaluation, notes)
    except (CheckpointError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for file in files:
        print(f"wrote {file} ({file.stat().st_size / 1024:.0f} KiB)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
