"""Runs compared: learning curves with seeds as bands and a table with intervals; two policies on the same serves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from pace.config.base import parse, require
from pace.config.commands import CompareConfig
from pace.config.overrides import override_task
from pace.devices import resolve_device
from pace.evaluation.bar import serve_bar
from pace.evaluation.paired import Paired, compare_records, play_listed
from pace.evaluation.report import write_json
from pace.evaluation.room import require_room
from pace.evaluation.task import own_pauses, policy_on, task_line
from pace.evaluation.text import Table, markdown_table, number, text_table
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.files import write_whole
from pace.runs.metrics import MILESTONES, Curve, passage, read_curve
from pace.runs.own_files import make_out
from pace.runs.run_folder import versions
from pace.studies.ablation import SHOWN_RATES, Curves, draw, needed
from pace.studies.run_groups import Given, differences, group_runs, read_run

PAGE, DATA = "compare.md", "compare.json"
#: 97.5 % quantiles of Student's t with 1, 2, ... degrees of freedom; the last one stands for more as well.
STUDENT = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131)
SEEDS_NOTE = "In brackets: of rates the 95 % interval of the mean over seeds (Student), of control steps their range."
PAIRED_HEAD = (
    "serves", "of both", "first %", "second %", "second - first", "95 %", "by world", "only first", "only second", "p",
)  # fmt: skip
PAIRED_NOTE = (
    "95 %: Newcombe's interval for pairs, which takes serves as independent. By world: half of the interval that takes "
    "worlds as such. Only: serves of which one policy alone was a hit (a success). p: McNemar's exact test."
)


def compare_from_config(composed: DictConfig) -> None:
    """Compare as configured; prints the tables, and writes them with their numbers and the figure.

    Errors: :class:`pace.config.ConfigError` if there is nothing to compare; :class:`CheckpointError` for what is no
    run; :class:`pace.evaluation.serves.EvaluationError`.
    """
    config = parse(composed, CompareConfig)
    runs = [read_run(path) for path in config.runs]
    policies = two_policies(config, runs)
    groups = group_runs(runs)
    curves = {name: [read_curve(str(run.metrics), config.window) for run in each] for name, each in groups.items()}
    curves = {name: seeds for name, seeds in curves.items() if any(len(seed.samples) for seed in seeds)}
    what = f"metrics of {config.window:g} control steps or more (window=)"
    require(bool(curves or policies), f"nothing to compare: no run has {what}, and two policies are played, no others")
    if policies:
        played = max(config.serves, config.worlds) + config.warmup_serves * config.worlds
        require_room(2 * played, config.worlds, resolve_device(config.device))
    out = make_out(config.out, "comparison", [PAGE, DATA, *([config.figure] if curves else [])])
    sections, files = [], []
    content: dict[str, Any] = {"runs": config.runs, "versions": versions()}
    if curves:
        sections.append(partial(curve_text, groups, curves))
        print(f"\n{sections[-1](text_table)}", flush=True)
        files.append(draw(curves, out / config.figure))
    if policies:
        found = play_both(config, *policies)
        sections.append(partial(paired_text, config.runs, found))
        print(f"\n{sections[-1](text_table)}\n")
        content["paired"] = {row: {name: vars(pair) for name, pair in each.items()} for row, each in found.items()}
    write_whole(out / PAGE, "# Comparison\n\n" + "\n\n".join(part(markdown_table) for part in sections) + "\n")
    write_json(out / DATA, content)
    for file in (out / PAGE, out / DATA, *files):
        print(f"wrote {file}")


# --- learning curves ----------------------------------------------------------------------------------------------


def curve_text(groups: Mapping[str, Sequence[Given]], curves: Curves, table: Table) -> str:
    """The groups with their runs and their differences, and the table of their rates."""
    values = differences({name: groups[name] for name in curves})
    lines = [
        f"{name}: {', '.join(str(run.path) for run in groups[name])}" + (f"; {values[name]}" if values[name] else "")
        for name in curves
    ]
    return "\n\n".join(["\n".join(f"- {line}" for line in lines), table(*rate_table(curves)), SEEDS_NOTE])


def rate_table(curves: Curves) -> tuple[list[str], list[list[str]]]:
    """Header and a row for each group: control steps to the milestones that one run reaches, and the rates at the last
    control step that all runs have reached."""
    runs = [seed for seeds in curves.values() for seed in seeds if len(seed.samples)]
    reached = [milestone for milestone in MILESTONES if any(passage(run, milestone) for run in runs)]
    end = min(run.samples[-1] for run in runs)
    head = ["", "seeds", *(f"M steps to {milestone.label}" for milestone in reached)]
    head += [f"{rate}, {unit}, at {end / 1e6:.3g} M" for rate, (_, unit, _) in SHOWN_RATES.items()]
    rows = []
    for name, seeds in curves.items():
        there = [rate_at(seeds, rate, end) for rate in SHOWN_RATES]
        rows.append([name, str(len(seeds)), *(needed(seeds, milestone) for milestone in reached), *there])
    return head, rows


def rate_at(seeds: Sequence[Curve], rate: str, end: float) -> str:
    """Mean over ``seeds`` of a rate at ``end`` control steps, with its interval."""
    factor, unit, places = SHOWN_RATES[rate]
    values = [factor * np.interp(end, seed.samples, seed.rates[rate]) for seed in seeds if len(seed.samples)]
    mean, half = mean_interval(values)
    if math.isnan(half):
        return number(mean, digits=places)
    low, high = max(0.0, mean - half), mean + half if unit == "/s" else min(factor, mean + half)
    return f"{mean:.{places}f} ({low:.{places}f} to {high:.{places}f})"


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean of independent ``values``, and half of its 95 % interval (Student); NaN for one value."""
    if len(values) < 2:
        return float(np.mean(values)), math.nan
    quantile = STUDENT[min(len(values) - 1, len(STUDENT)) - 1]
    return float(np.mean(values)), quantile * float(np.std(values, ddof=1)) / math.sqrt(len(values))


# --- the same serves ----------------------------------------------------------------------------------------------


def two_policies(config: CompareConfig, runs: Sequence[Given]) -> tuple[TaskPolicy, TaskPolicy] | None:
    """The policies of exactly two runs on the task that they play, which is told; None if none are to be played."""
    if not config.play or len(runs) != 2 or not all(run.config for run in runs):
        return None
    resolve_device(config.device)  # wrong ones raise before the work
    saved = [load_policy(run.path) for run in runs]
    first, second = (policy_on(config.task, policy) for policy in saved)
    for own, played in zip(saved, (first, second), strict=True):
        task = override_task(played.config, changes(config, played))
        for row in config.rows:
            override_task(task, [f"serve={row}"])
        print(f"policy {own.source}\n{task_line(config.task, own.config, task)}", flush=True)
    return first, second


def changes(config: CompareConfig, policy: TaskPolicy) -> list[str]:
    """Overrides of the task that ``policy`` plays."""
    pauses = own_pauses(config.task, policy.config)
    return [f"engine.physics_dt={config.physics_dt}", *pauses, *config.overrides]


def play_both(config: CompareConfig, first: TaskPolicy, second: TaskPolicy) -> dict[str, dict[str, Paired]]:
    """Hits and successes of both policies on the same serves, by serve range."""
    return {row: compare_records(*(records_of(config, each, row) for each in (first, second))) for row in config.rows}


def records_of(config: CompareConfig, policy: TaskPolicy, row: str) -> Tensor:
    """Records of one policy and one serve range, with a progress bar."""
    label = f"{Path(policy.source).name[:20]}, {row}"
    with serve_bar(label, config.serves, config.progress) as show:
        return play_listed(
            policy,
            row,
            config.serves,
            config.worlds,
            config.device,
            config.seed,
            changes(config, policy),
            config.warmup_serves,
            show,
        )


def paired_text(names: Sequence[str], found: Mapping[str, Mapping[str, Paired]], table: Table) -> str:
    """The table of both policies on the same serves."""
    who = f"first: {names[0]}; second: {names[1]}"
    return "\n\n".join([who, table(PAIRED_HEAD, paired_rows(found)), PAIRED_NOTE])


def paired_rows(found: Mapping[str, Mapping[str, Paired]]) -> list[list[str]]:
    """A row for each serve range and each of hit and success, under :data:`PAIRED_HEAD`; per cent."""
    return [
        [
            f"{row}, {name}",
            f"{pair.serves:,}",
            *(number(share, 100) for share in pair.shares),
            f"{100 * pair.difference:+.1f}",
            f"{100 * pair.low:+.1f} to {100 * pair.high:+.1f}",
            number(pair.by_world, 100),
            *(str(count) for count in pair.only),
            f"{pair.p_value:.2g}",
        ]
        for row, each in found.items()
        for name, pair in each.items()
    ]
