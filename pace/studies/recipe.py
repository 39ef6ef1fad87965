"""The table and the figure of ``docs/results/recipe.md``: the recipes that were tried, one run per row.

``runs.csv`` in the folder ``recipe`` of the results lists the runs; ``<recipe>_seed<seed>.csv`` beside it are their
metrics, and ``<recipe>.yaml`` is the resolved configuration.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from matplotlib.figure import Figure

from pace.runs.files import write_figure
from pace.runs.metrics import MILESTONES, Curve, markdown, passage, passage_text, read_curve, write_slim
from pace.runs.run_folder import METRICS
from pace.studies.ablation import run_name

DASHES = ("-", "--", ":")
TICKS = (0.5, 1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 60)  # millions of control steps
HEAD = ("recipe", "seed", "what changed", "M steps", *(milestone.label for milestone in MILESTONES))


@dataclass(frozen=True)
class Tried:
    """A line of ``runs.csv``: a run of ``recipe``, which may start from another run."""

    recipe: str
    seed: int
    run: str  # name of its run folder
    from_samples: float  # control steps of the run that it started from
    from_minutes: float
    change: str
    file: Path  # its metrics

    def curve(self) -> Curve:
        """Moving averages; control steps and minutes include those of the run that it started from."""
        own = read_curve(self.file)
        return replace(own, samples=own.samples + self.from_samples, minutes=own.minutes + self.from_minutes)


def listed(folder: Path) -> list[Tried]:
    """All lines of ``runs.csv`` in ``folder``."""
    with (folder / "runs.csv").open(encoding="utf-8", newline="") as file:
        return [
            Tried(
                row["recipe"],
                int(row["seed"]),
                row["run"],
                float(row["from_samples"]),
                float(row["from_minutes"]),
                row["change"],
                folder / f"{run_name(row['recipe'], int(row['seed']))}.csv",
            )
            for row in csv.DictReader(file)
        ]


def take_over(runs: Sequence[Tried], source: Path) -> None:
    """Write the metrics of the run folders of ``runs`` in ``source``, four rows pooled into one, to their files."""
    for tried in runs:
        if (source / tried.run / METRICS).exists():
            write_slim(source / tried.run / METRICS, tried.file)


def table(curves: Mapping[Tried, Curve]) -> str:
    """Millions of control steps, and minutes in brackets, to each milestone, as Markdown."""
    rows = []
    for tried, curve in curves.items():
        reached = [passage_text(passage(curve, milestone)) for milestone in MILESTONES]
        rows.append([tried.recipe, str(tried.seed), tried.change, f"{curve.samples[-1] / 1e6:.1f}", *reached])
    return markdown(HEAD, rows)


def draw(curves: Mapping[Tried, Curve], file: Path) -> Path:
    """All curves as a PNG, a colour for each recipe, a dash for each seed; returns ``file``."""
    figure = Figure(figsize=(13, 11), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    names = list(dict.fromkeys(tried.recipe for tried in curves))
    for axes, rate in zip(panels, ("hits", "returns", "falls"), strict=True):
        for tried, curve in curves.items():
            number = names.index(tried.recipe)
            style = {"color": f"C{number % 10}", "linestyle": DASHES[tried.seed - 1], "lw": 1.0 + number // 10}
            label = f"{tried.recipe.replace('_', ' ')}, seed {tried.seed}"
            axes.plot(curve.samples / 1e6, curve.rates[rate], label=label, **style)
        axes.set(ylabel="falls per second" if rate == "falls" else f"{rate}, share of serves", xscale="log")
        axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel("control steps, millions")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    write_figure(file, figure, dpi=100)
    return file
