"""An evaluation from its configuration: the table of serve ranges, the robustness sweep, and their files."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from pace.config.base import parse, to_dict
from pace.config.commands import EvaluateConfig
from pace.config.overrides import override_task
from pace.config.training import TrainConfig
from pace.devices import resolve_device
from pace.evaluation.bar import serve_bar
from pace.evaluation.figures import FIGURES, write_figures
from pace.evaluation.first_ball import first_ball_row
from pace.evaluation.quality import QualityRecorder
from pace.evaluation.report import FILES as REPORT
from pace.evaluation.report import describe, tables, write_report
from pace.evaluation.room import require_room
from pace.evaluation.serves import MakeRecorder, Row, evaluate_row
from pace.evaluation.sweep import FILES as SWEEP
from pace.evaluation.sweep import (
    Cell,
    Tables,
    cells_to_play,
    engine_name,
    finished_cells,
    plan_cell,
    plan_first_balls,
    variations,
    write_sweep,
)
from pace.evaluation.task import own_pauses, policy_on, task_line
from pace.rl.policies import TaskPolicy, built_in_policy, load_policy
from pace.runs.own_files import make_out
from pace.runs.progress import clock
from pace.runs.run_folder import versions

TASK_PARTS = ("robot", "ball", "engine", "randomization", "sensing")  # parts of the task in the report


def evaluate_from_config(composed: DictConfig) -> None:
    """Evaluate as configured, and print the results and the files."""
    config = parse(composed, EvaluateConfig)
    saved = choose_policy(config)
    policy = policy_on(config.task, saved)
    pauses = own_pauses(config.task, saved.config)
    overrides = [f"engine.physics_dt={config.physics_dt}", *pauses, *config.overrides]
    context = circumstances(config, policy, overrides)
    task = override_task(policy.config, overrides)
    told = task_line(config.task, saved.config, task)
    print(f"policy {policy.source}\n{told}\n{describe(context)}", flush=True)
    cells = plan(config, policy, task, overrides, context["versions"])
    require_rooms(config, cells)
    folder = make_out(config.out, "evaluation", files_of(config))
    finished = finished_cells(folder, cells) if cells else {}
    if config.rows:
        first = evaluate_table(config, policy, task, overrides, folder, context)
        finished |= played_first_balls(config, cells, first)
    if cells:
        _announce(run_sweep(config, policy, cells, finished, folder, context))


def files_of(config: EvaluateConfig) -> list[str]:
    """Names of the files that an evaluation writes."""
    return [*((*REPORT, *FIGURES) if config.rows else ()), *(SWEEP if config.sweep else ())]


def require_rooms(config: EvaluateConfig, cells: Sequence[Cell]) -> None:
    """Errors: :class:`ConfigError` if a table, which keeps the records of all rows, or a cell does not fit."""
    device, worlds = resolve_device(config.device), config.worlds_for(config.serves)
    played = max(config.serves, worlds) + config.warmup_serves * worlds
    if config.rows:
        require_room(played * len(config.rows), worlds, device)
    if config.first_ball and (config.rows or cells):
        require_room(config.first_ball_worlds, config.first_ball_worlds, device)
    for cell in cells:
        require_room(cell.serves + config.warmup_serves * cell.worlds, cell.worlds, resolve_device(cell.device))


def plan(
    config: EvaluateConfig, policy: TaskPolicy, task: TrainConfig, overrides: Sequence[str], program: Any
) -> list[Cell]:
    """The cells of the sweep, if there is one: its changes, then the first balls."""
    if not config.sweep:
        return []
    changes = variations(task, config.variations, config.reality)
    cells = [plan_cell(change, config, policy, overrides, program) for change in changes]
    return cells + plan_first_balls(config, policy, overrides, program)


def played_first_balls(config: EvaluateConfig, cells: Sequence[Cell], first: Mapping[str, Any]) -> Tables:
    """Those first balls of the sweep that the table has played (``first``, of :func:`first_balls`), by key of cell."""
    if config.sweep_rows != [first["serve"]]:
        return {}
    rows = {row["wait"]: row for row in first["rows"]}
    return {cell.key: [rows[cell.wait]] for cell in cells if cell.wait in rows}


def evaluate_table(
    config: EvaluateConfig,
    policy: TaskPolicy,
    task: TrainConfig,
    overrides: Sequence[str],
    folder: Path,
    context: Mapping[str, Any],
) -> dict[str, Any]:
    """Play the rows that ``config`` names, print their table and write it with its figures into ``folder``.

    Returns the first balls, which the table has too.
    """
    worlds = config.worlds_for(config.serves)
    record = partial(QualityRecorder, config=config.quality)
    rows: list[Row] = []
    for name in config.rows:
        rows.append(_with_bar(config, policy, name, name, config.serves, worlds, config.device, overrides, record))
        write_report(folder, rows, config.paper, context)  # an evaluation that is stopped keeps its finished rows
    first = first_balls(config, policy, overrides)
    print(f"\n{tables(rows, config.paper, first_ball=first)}\n")
    files = write_report(folder, rows, config.paper, context, first)
    target = (task.landing_target[0], task.landing_target[1])
    _announce([*files, *write_figures(folder, rows, task.ball.table, target, config.warmup_serves)])
    return first


def first_balls(config: EvaluateConfig, policy: TaskPolicy, overrides: Sequence[str]) -> dict[str, Any]:
    """The first ball after standing ready for each time of ``config``; the row of each."""
    serve = config.first_ball_serve
    rows = [_first_ball(config, policy, wait, serve, config.device, overrides) for wait in config.first_ball]
    return {"serve": serve, "ball": config.first_ball_kind, "rows": rows}


def _first_ball(
    config: EvaluateConfig, policy: TaskPolicy, wait: float, serve: str, device: str, overrides: Sequence[str]
) -> dict[str, Any]:
    """The row of one time, with a progress bar of its robots."""
    worlds, kind = config.first_ball_worlds, config.first_ball_kind
    with serve_bar(f"first ball after {wait:g} s", worlds, config.progress) as show:
        return first_ball_row(policy, wait, worlds, serve, kind, device, config.seed, overrides, show)


def choose_policy(config: EvaluateConfig) -> TaskPolicy:
    """The policy that ``config`` names: a saved one, or a built-in on the saved or the default task."""
    saved = load_policy(config.run) if config.run else None
    if config.policy == "run":
        assert saved is not None  # guaranteed by EvaluateConfig
        return saved
    return built_in_policy(config.policy, config.seed, saved, config.device)


def circumstances(config: EvaluateConfig, policy: TaskPolicy, overrides: Sequence[str]) -> dict[str, Any]:
    """The settings that the numbers depend on, for the report.

    Errors: :class:`pace.config.ConfigError` for an unknown serve range and a physics step that does not divide the
    control step, before hours of simulation.
    """
    first = [config.first_ball_serve] if config.rows and config.first_ball else []
    for name in (*config.rows, *first, *(config.sweep_rows if config.sweep else ())):
        override_task(policy.config, [f"serve={name}"])
    task = override_task(policy.config, overrides)
    device = resolve_device(config.device)
    return {
        "policy": policy.source,
        "task_name": config.task,
        "counters": dict(policy.counters),
        "ball": task.ball.name,
        "engine": engine_name(task, device.type),
        "device": str(device),
        "physics_dt": task.robot.control_dt / task.substeps,
        "randomization": task.randomization.name,
        "sensing": task.sensing.name,
        "seed": config.seed,
        "num_worlds": config.worlds_for(config.serves),
        "warmup_serves": config.warmup_serves,
        "overrides": list(overrides),
        "versions": versions(),
        "task": {name: value for name, value in to_dict(task).items() if name in TASK_PARTS},
    }


def run_sweep(
    config: EvaluateConfig,
    policy: TaskPolicy,
    cells: Sequence[Cell],
    finished: Tables,
    folder: Path,
    context: Mapping[str, Any],
) -> list[Path]:
    """Play those ``cells`` that are not ``finished``; the files in ``folder`` are up to date after each.

    A change without effect is not played again. Returns the files.
    """
    open_cells = cells_to_play(cells, finished)
    print(f"\nsweep: {len(cells)} cells, {len(open_cells)} to play; finished ones go to {folder}", flush=True)
    total, done, started = sum(cell.cost for cell in open_cells), 0.0, time.monotonic()
    files = write_sweep(folder, cells, finished, context) if not open_cells else []
    for number, cell in enumerate(open_cells, 1):
        try:
            finished[cell.key] = play_cell(config, policy, cell)
            files = write_sweep(folder, cells, finished, context)
        except KeyboardInterrupt:
            print(f"\nto resume: the same command with rows=[] out={folder}", file=sys.stderr)
            raise
        done += cell.cost
        left = clock((time.monotonic() - started) * (total - done) / done)
        print(f"{number}/{len(open_cells)} | {left} left | {cell_text(cell, finished[cell.key])}", flush=True)
    return files


def play_cell(config: EvaluateConfig, policy: TaskPolicy, cell: Cell) -> list[dict[str, Any]]:
    """Summaries of the rows of a cell."""
    label, wait = cell.variation.label, cell.wait
    if wait is not None:
        serves = config.sweep_rows
        return [_first_ball(config, policy, wait, serve, cell.device, cell.overrides) for serve in serves]
    return [
        _with_bar(
            config, policy, name, f"{label}, {name}", cell.serves, cell.worlds, cell.device, cell.overrides
        ).summary
        for name in config.sweep_rows
    ]


def cell_text(cell: Cell, rows: Sequence[Mapping[str, Any]]) -> str:
    """A finished cell in one line."""
    shares = (f"{row['serve']} {100 * row['hit']:.0f}/{100 * row['success']:.0f}" for row in rows)
    return f"{cell.variation.label}: hit/success % {', '.join(shares)} ({rows[0]['serves']:,} serves a row)"


def _with_bar(
    config: EvaluateConfig,
    policy: TaskPolicy,
    serve: str,
    label: str,
    serves: int,
    num_worlds: int,
    device: str,
    overrides: Sequence[str],
    record: MakeRecorder | None = None,
) -> Row:
    """One row, with a progress bar of its serves."""
    with serve_bar(label, serves, config.progress) as show:
        return evaluate_row(
            policy, serve, serves, num_worlds, device, config.seed, overrides, config.warmup_serves, show, record
        )


def _announce(files: Sequence[Path]) -> None:
    for file in files:
        print(f"wrote {file}")
