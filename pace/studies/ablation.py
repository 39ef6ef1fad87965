"""An ablation from its configuration: the effect of each part of the recipe (figure 6 of the paper).

A second call skips finished runs and resumes the others.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from omegaconf import DictConfig

from pace.config.base import parse
from pace.config.commands import AblateConfig
from pace.runs.files import write_figure
from pace.runs.metrics import MILESTONES, Array, Curve, Milestone, markdown, passage, read_curve, write_slim
from pace.runs.own_files import make_out
from pace.runs.queue import Run, RunQueue, check_settings
from pace.runs.run_folder import METRICS

DPI = 110
COLOURS, DASHES = 10, ("-", "--", ":")  # of the figure: the next dash after the last colour
#: Rate of a curve -> factor, unit and decimal places of its display.
SHOWN_RATES = {"hits": (100.0, "%", 1), "returns": (100.0, "%", 1), "falls": (1.0, "/s", 3)}
Curves = dict[str, list[Curve]]  # of the available seeds, by experiment


class AblationError(RuntimeError):
    """Runs that failed, or nothing to draw; the message names them."""


def ablate_from_config(composed: DictConfig) -> None:
    """Train the unfinished runs, then write CSVs and figure and print the table.

    Errors: :class:`AblationError`, at the end, if runs failed.
    """
    config = parse(composed, AblateConfig)
    tables = [f"{run.name}.csv" for run in planned_runs(config)] if config.train else []
    out = make_out(config.out, "ablation", [config.figure, *tables])
    failures: Mapping[str, str] = {}
    if config.train:
        failures = train(config, out)
    curves = read_curves(config, out)
    print(f"\n{summary(curves)}\n\nwrote {draw(curves, out / config.figure)}")
    if failures:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in failures.items())
        raise AblationError(f"{len(failures)} runs failed, the same command tries them again: {reasons}")


def planned_runs(config: AblateConfig) -> list[Run]:
    """One run for each experiment and seed; the first seed of all experiments comes first."""
    folder = Path(config.out)
    return [
        Run(
            folder / run_name(experiment, seed),
            (f"experiment={experiment}", f"seed={seed}", *config.overrides),
            config.samples,
        )
        for seed in config.seeds
        for experiment in config.experiments
    ]


def run_name(experiment: str, seed: int) -> str:
    """Name of a run's folder and of its CSV: ``ablation/baseline`` with seed 1 is ``baseline_seed1``."""
    return f"{short_name(experiment)}_seed{seed}"


def short_name(experiment: str) -> str:
    """Name of an experiment without its folder."""
    return experiment.rpartition("/")[2]


def train(config: AblateConfig, out: Path) -> Mapping[str, str]:
    """Train the runs and write their CSVs into ``out``; returns the reasons of those that failed."""
    runs = [check_settings(run) for run in planned_runs(config)]
    queue = RunQueue(runs, config.jobs, config.progress)
    try:
        queue.play()
    except KeyboardInterrupt:
        print(f"\nto resume: the same command; finished and saved runs are in {config.out}", file=sys.stderr)
        raise
    for run in runs:
        if (run.folder / METRICS).exists():
            print(f"wrote {write_slim(run.folder / METRICS, out / f'{run.name}.csv')}")
    return queue.failures


def read_curves(config: AblateConfig, out: Path) -> Curves:
    """Curves of the CSVs in ``out``. Errors: :class:`AblationError` if there is none."""
    files = {name: [out / f"{run_name(name, seed)}.csv" for seed in config.seeds] for name in config.experiments}
    curves = {
        name: [read_curve(file, config.window) for file in there if file.exists()] for name, there in files.items()
    }
    curves = {name: seeds for name, seeds in curves.items() if seeds}
    if not curves:
        raise AblationError(f"{out} has no CSV of {', '.join(config.experiments)}: nothing to draw")
    return curves


def summary(curves: Curves) -> str:
    """A row for each experiment: the control steps to each milestone that one of them reaches, its rates at the last
    control step that all runs have reached, and its speed."""
    runs = [curve for seeds in curves.values() for curve in seeds]
    reached = [milestone for milestone in MILESTONES if any(passage(curve, milestone) for curve in runs)]
    end = min((curve.samples[-1] for curve in runs if len(curve.samples)), default=0.0)
    head = ["M control steps to", *(milestone.label for milestone in reached)]
    head += [f"{rate}, {unit}, at {end / 1e6:.1f} M" for rate, (_, unit, _) in SHOWN_RATES.items()]
    head.append("control steps a second")
    rows = []
    for name, seeds in curves.items():
        there = [at_end(seeds, rate, end) for rate in SHOWN_RATES]
        rows.append(
            [f"`{short_name(name)}`", *(needed(seeds, milestone) for milestone in reached), *there, speed(seeds)]
        )
    return markdown(head, rows)


def speed(seeds: Sequence[Curve]) -> str:
    """Control steps a second, median over the points of all ``seeds``: pauses do not count."""
    rates = [np.diff(curve.samples) / (60.0 * np.diff(curve.minutes)) for curve in seeds if len(curve.samples) > 1]
    return f"{np.median(np.concatenate(rates)):,.0f}" if rates else "-"


def at_end(seeds: Sequence[Curve], rate: str, end: float) -> str:
    """Mean and range over ``seeds`` of a rate at ``end`` control steps."""
    factor, _, places = SHOWN_RATES[rate]
    values = [factor * np.interp(end, curve.samples, curve.rates[rate]) for curve in seeds if len(curve.samples)]
    if not values:
        return "-"
    text = f"{np.mean(values):.{places}f}"
    return f"{text} ({min(values):.{places}f} to {max(values):.{places}f})" if len(seeds) > 1 else text


def needed(seeds: Sequence[Curve], milestone: Milestone) -> str:
    """Median and range over ``seeds`` of the millions of control steps to ``milestone``.

    A seed that does not reach it counts as slower than all others.
    """
    found = [passage(curve, milestone) for curve in seeds]
    reached = sorted(place.samples / 1e6 for place in found if place is not None)
    middle = median([*reached, *[np.inf] * (len(seeds) - len(reached))])
    text = f"{middle:.1f}" if np.isfinite(middle) else "-"
    if not reached:
        return "-"
    if len(reached) < len(seeds):
        return f"{text} ({len(reached)} of {len(seeds)} seeds)"
    return f"{text} ({reached[0]:.1f} to {reached[-1]:.1f})" if len(seeds) > 1 else text


def draw(curves: Curves, file: Path) -> Path:
    """Hits and returns of each experiment: median and range over its seeds against millions of control steps."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    for axes, rate in zip(figure.subplots(1, 2), ("hits", "returns"), strict=True):
        for number, (name, seeds) in enumerate(curves.items()):
            _draw_experiment(axes, number, short_name(name).replace("_", " "), seeds, rate)
        axes.set(xlabel="control steps, millions", ylabel=f"{rate}, % of serves")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    write_figure(file, figure, dpi=DPI)
    return file


def _draw_experiment(axes: Axes, number: int, name: str, seeds: Sequence[Curve], rate: str) -> None:
    samples, values = over_seeds(seeds, rate)
    label = f"{name} ({len(seeds)} seed{'s' if len(seeds) > 1 else ''})"
    color, dash = f"C{number % COLOURS}", DASHES[number // COLOURS % len(DASHES)]
    axes.plot(samples / 1e6, 100 * np.median(values, 0), color=color, ls=dash, label=label)
    if len(seeds) > 1:
        axes.fill_between(samples / 1e6, 100 * values.min(0), 100 * values.max(0), color=color, alpha=0.15, lw=0)


def over_seeds(seeds: Sequence[Curve], rate: str) -> tuple[Array, Array]:
    """Control steps (M,) that all ``seeds`` have reached, and their ``rate`` (S, M) there, interpolated."""
    end = min((curve.samples[-1] for curve in seeds if len(curve.samples)), default=0.0)
    samples = np.unique(np.concatenate([curve.samples for curve in seeds]))
    samples = samples[samples <= end]
    values = [np.interp(samples, curve.samples, curve.rates[rate]) for curve in seeds if len(curve.samples)]
    return samples, np.array(values) if values else np.zeros((1, 0))
