"""The model card of a published policy: its task, training, results and commands, as Markdown."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pace.config.renamed import current_override
from pace.config.schedules import Stage
from pace.config.training import TrainConfig
from pace.evaluation.quality_report import more_tables
from pace.evaluation.text import markdown_table
from pace.rl.policies import saved_config
from pace.runs.checkpoint import load_checkpoint

CARD = "README.md"
EVALUATION, SWEEP, VERSIONS = "evaluation.json", "sweep.json", "versions.json"
GROUPS = ("robot", "ball", "serve", "randomization", "sensing", "observation", "reward", "predictor", "algo")
TASK = "task, at the end"
FIRST_ROW = f"| {TASK} |"  # of a card: what tells one from another README.md
#: Keys of the machine, not of the task.
MACHINE = ("engine.threads=", "engine.graph=", "engine.physics_dt=")


def card(folder: Path, notes: str = "") -> str:
    """The model card of the policy in ``folder``, from the files there; ``notes`` stand below its first table."""
    parts = [f"# {folder.name}", _facts(folder, _read(folder / VERSIONS)), notes.strip()]
    evaluation, sweep = _read(folder / EVALUATION), _read(folder / SWEEP)
    parts += [_evaluation(folder, evaluation)] if evaluation.get("rows") else []
    parts += [_sweep(sweep)] if sweep.get("cells") else []
    return "\n\n".join(part for part in parts if part) + "\n"


def _read(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


def _facts(folder: Path, versions: Mapping[str, Any]) -> str:
    checkpoint = load_checkpoint(folder, weights_only=True)
    counters, config = checkpoint.counters, saved_config(checkpoint)
    command = versions.get("command", [])[1:]
    named = [(group, getattr(config, group).name) for group in GROUPS]
    rows = [
        (TASK, ", ".join(f"`{group}={name}`" for group, name in named)),
        ("curriculum", _curriculum(config)),
        ("seed", str(config.seed)),
        ("control steps", f"{counters['samples'] / 1e6:.1f} million"),
        ("time", f"{counters['wall_s'] / 3600:.1f} h, {config.num_worlds:,} worlds"),
        ("last command", f"`python -m pace.rl.train {' '.join(command)}`" if command else ""),
        ("versions", ", ".join(f"{name} {number}" for name, number in versions.get("packages", {}).items() if number)),
    ]
    return markdown_table(("", ""), [row for row in rows if row[1]]).replace("---:", "---")


def _curriculum(config: TrainConfig) -> str:
    """Where each stage begins, and its changes."""

    def begin(stage: Stage) -> str:
        return f"{stage.place / 1e6:g} M" if stage.share is None else f"{100 * stage.share:g} %"

    return ", ".join(f"{begin(stage)}: {' '.join(stage.task)}" for stage in config.curriculum)


def _evaluation(folder: Path, found: Mapping[str, Any]) -> str:
    overrides = [current_override(text) for text in found["overrides"] if not text.startswith(MACHINE)]
    fixed = [f"task={found.get('task_name', 'own')}"]  # files of before there was a choice: the policy's own
    fixed += [f"{key}={found[key]}" for key in ("physics_dt", "num_worlds", "warmup_serves", "seed")]
    serves = f"serves={min(row['serves'] for row in found['rows'])}"
    command = " ".join(["python -m pace.evaluation", f"pretrained/{folder.name}", *fixed, serves, *overrides])
    parts = ["## Evaluation", f"`{command}`", serves_table(found), *more_tables(found, markdown_table)]
    return "\n\n".join(parts)


def serves_table(found: Mapping[str, Any]) -> str:
    """The serve ranges of an evaluation with their rates."""
    return markdown_table(
        ("serves", "number", "hit %", "success %", "falls per 1,000"), [_row(row) for row in found["rows"]]
    )


def _sweep(found: Mapping[str, Any]) -> str:
    rows = [
        [f"{cell['kind'].replace('_', ' ')} {cell['value']}".strip(), *_row(row)]
        for cell in found["cells"]
        for row in cell["rows"]
    ]
    head = ("change", "serves", "number", "hit %", "success %", "falls per 1,000")
    return f"## Robustness sweep\n\n{markdown_table(head, rows)}"


def _row(row: Mapping[str, Any]) -> Sequence[str]:
    hit, success = (
        f"{100 * row[name]:.1f} ({100 * row[f'{name}_low']:.1f} to {100 * row[f'{name}_high']:.1f})"
        for name in ("hit", "success")
    )
    return row["serve"].replace("_", "-"), f"{row['serves']:,}", hit, success, f"{row['falls_per_1000']:.1f}"
