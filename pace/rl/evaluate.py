"""``python -m pace.rl.evaluate RUN``: the paper's table of hits and returns for a policy. ``--help`` shows every key.

Examples::

    python -m pace.rl.evaluate runs/2026-01-01_pace                       # four serve ranges, 5,000 serves each
    python -m pace.rl.evaluate pretrained/pace serves=40000 ball=paper randomization=none
    python -m pace.rl.evaluate runs/2026-01-01_pace rows=[mixed] engine=mjwarp out=/tmp/mjwarp
    python -m pace.rl.evaluate policy=random serves=500 physics_dt=0.01   # what chance does
    python -m pace.rl.evaluate runs/2026-01-01_pace --sweep               # and what the policy survives

RUN is a run folder, a checkpoint in one, or ``pretrained/<name>``. The task is rebuilt from what was saved with it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from tqdm import tqdm

from pace.command import run_command
from pace.config import EvaluateConfig, TrainConfig, parse, to_dict
from pace.rl.checkpoint import CheckpointError
from pace.rl.evaluation import EvaluationError, Row, evaluate_row
from pace.rl.evaluation_figures import write_figures
from pace.rl.evaluation_report import describe, tables, write_report
from pace.rl.loading import CHANGEABLE, TaskPolicy, built_in_policy, load_policy, override_task
from pace.rl.progress import SECONDS_PER_LINE
from pace.rl.run_folder import default_run_dir, versions
from pace.rl.sweep import Variation, variations, write_sweep
from pace.sim.engine import resolve_device

TASK_PARTS = ("robot", "ball", "engine", "randomization", "sensing")  # what the report says of the task


def main() -> int:
    """Entry point; returns the exit status."""
    sys.argv[1:] = ["sweep=true" if argument == "--sweep" else argument for argument in sys.argv[1:]]
    failures = (CheckpointError, EvaluationError)
    return run_command(evaluate_from_config, "evaluate", failures, positional="run", task_groups=CHANGEABLE)


def evaluate_from_config(composed: DictConfig) -> None:
    """Evaluate as the composed configuration says, and print what was measured and written."""
    config = parse(composed, EvaluateConfig)
    policy = choose_policy(config)
    overrides = [f"engine.physics_dt={config.physics_dt}", *config.overrides]
    context = circumstances(config, policy, overrides)
    folder = Path(config.out) if config.out else default_run_dir("evaluation")
    print(f"policy {policy.source}\n{describe(context)}", flush=True)
    rows = evaluate_rows(config, policy, overrides)
    folder.mkdir(parents=True, exist_ok=True)
    print(f"\n{tables(rows, config.paper)}\n")
    task = override_task(policy.config, overrides)
    target = task.reward.terms["predicted_landing"].params
    files = write_report(folder, rows, config.paper, context)
    files += write_figures(folder, rows, task.ball.table, (target["x"], target["y"]))
    _announce(files)
    if config.sweep:
        cells = variations(task, config.variations)
        _announce(write_sweep(folder, cells, sweep_tables(config, policy, overrides, cells), context))


def choose_policy(config: EvaluateConfig) -> TaskPolicy:
    """The policy that ``config`` names: a saved one, or a built-in on the saved or the default task."""
    saved = load_policy(config.run) if config.run else None
    if config.policy == "run":
        assert saved is not None  # EvaluateConfig has seen to it
        return saved
    return built_in_policy(config.policy, config.seed, saved, config.device)


def circumstances(config: EvaluateConfig, policy: TaskPolicy, overrides: Sequence[str]) -> dict[str, Any]:
    """What the figures depend on, for the report.

    Errors: :class:`pace.config.ConfigError` for an unknown serve range and a physics step that does not divide the
    control step, so that they come before hours of play.
    """
    for name in (*config.rows, *(config.sweep_rows if config.sweep else ())):
        override_task(policy.config, [f"serve={name}"])
    task = override_task(policy.config, overrides)
    device = resolve_device(config.device)
    return {
        "policy": policy.source,
        "counters": dict(policy.counters),
        "ball": task.ball.name,
        "engine": engine_name(task, device.type),
        "device": str(device),
        "physics_dt": task.robot.control_dt / task.substeps,
        "randomization": task.randomization.name,
        "sensing": task.sensing.name,
        "seed": config.seed,
        "num_worlds": config.num_worlds,
        "warmup_serves": config.warmup_serves,
        "overrides": list(overrides),
        "versions": versions(),
        "task": {name: value for name, value in to_dict(task).items() if name in TASK_PARTS},
    }


def engine_name(task: TrainConfig, device_type: str) -> str:
    """The engine that ``auto`` means on a device."""
    if task.engine.name != "auto":
        return task.engine.name
    return "mjwarp" if device_type == "cuda" else "native"


def evaluate_rows(config: EvaluateConfig, policy: TaskPolicy, overrides: Sequence[str]) -> list[Row]:
    """The rows that ``config`` names."""
    return [_with_bar(config, policy, name, name, config.serves, overrides) for name in config.rows]


def sweep_tables(
    config: EvaluateConfig, policy: TaskPolicy, overrides: Sequence[str], cells: Sequence[Variation]
) -> list[list[dict[str, Any]]]:
    """Summaries of the rows of each cell; a change that changes nothing is not played again."""
    device = resolve_device(config.device).type
    known: dict[str, list[dict[str, Any]]] = {}
    result: list[list[dict[str, Any]]] = []
    for cell in cells:
        changed = [*overrides, *cell.overrides]
        task = override_task(policy.config, changed)
        task.engine.name = engine_name(task, device)
        key = str(task)
        if key not in known:
            known[key] = [
                _with_bar(config, policy, name, f"{cell.label}, {name}", config.sweep_serves, changed).summary
                for name in config.sweep_rows
            ]
        result.append(known[key])
    return result


def _with_bar(
    config: EvaluateConfig, policy: TaskPolicy, serve: str, label: str, serves: int, overrides: Sequence[str]
) -> Row:
    """One row, with a progress bar of its serves."""
    interval = 0.2 if sys.stderr.isatty() else SECONDS_PER_LINE
    look = {"desc": f"{label:<10}", "unit": "serve", "disable": not config.progress, "mininterval": interval}
    with tqdm(total=serves, **look) as bar:

        def show(counted: int) -> None:
            bar.update(min(counted, serves) - bar.n)

        worlds = min(config.num_worlds, serves)
        return evaluate_row(
            policy, serve, serves, worlds, config.device, config.seed, overrides, config.warmup_serves, show
        )


def _announce(files: Sequence[Path]) -> None:
    for file in files:
        print(f"wrote {file}")


if __name__ == "__main__":
    sys.exit(main())
