"""The table and the figure of ``docs/recipe.md``: python -m docs.plot_recipe [FOLDER_OF_RUNS]

``docs/recipe/runs.csv`` lists the runs, and ``docs/recipe/<experiment>_seed<seed>.csv`` are their metrics. With a
folder of run folders, the metrics of those runs that it holds are taken from there first. Prints the table as Markdown
and writes ``docs/figures/recipe.png``.
"""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from matplotlib.figure import Figure

from pace.runs.metrics import MILESTONES, Curve, markdown, passage, passage_text, read_curve, write_slim
from pace.studies.ablation import run_name

HERE = Path(__file__).resolve().parent
FOLDER, FIGURE = HERE / "recipe", HERE / "figures" / "recipe.png"
DASHES = ("-", "--", ":")
TICKS = (0.5, 1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 60)  # millions of control steps
HEAD = ("experiment", "seed", "what changed", "M steps", *(milestone.label for milestone in MILESTONES))


@dataclass(frozen=True)
class Tried:
    """A line of ``runs.csv``: a run of ``experiment``, from where another one had got to."""

    experiment: str
    seed: int
    run: str  # folder that it was made in
    from_samples: float  # control steps
    from_minutes: float
    change: str

    @property
    def file(self) -> Path:
        """Its metrics."""
        return FOLDER / f"{run_name(self.experiment, self.seed)}.csv"

    def curve(self) -> Curve:
        """Moving averages; control steps and minutes count from the start of the run that it went on from."""
        own = read_curve(self.file)
        return replace(own, samples=own.samples + self.from_samples, minutes=own.minutes + self.from_minutes)


def listed() -> list[Tried]:
    """All lines of ``runs.csv``."""
    with (FOLDER / "runs.csv").open(newline="") as file:
        return [
            Tried(
                row["experiment"],
                int(row["seed"]),
                row["run"],
                float(row["from_samples"]),
                float(row["from_minutes"]),
                row["change"],
            )
            for row in csv.DictReader(file)
        ]


def table(curves: dict[Tried, Curve]) -> str:
    """Millions of control steps, and minutes in brackets, to each milestone."""
    rows = []
    for tried, curve in curves.items():
        reached = [passage_text(passage(curve, milestone)) for milestone in MILESTONES]
        rows.append([tried.experiment, str(tried.seed), tried.change, f"{curve.samples[-1] / 1e6:.1f}", *reached])
    return markdown(HEAD, rows)


def draw(curves: dict[Tried, Curve]) -> None:
    """All curves: a colour an experiment, a dash a seed."""
    figure = Figure(figsize=(13, 11), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    names = list(dict.fromkeys(tried.experiment for tried in curves))
    for axes, rate in zip(panels, ("hits", "returns", "falls"), strict=True):
        for tried, curve in curves.items():
            number = names.index(tried.experiment)
            style = {"color": f"C{number % 10}", "linestyle": DASHES[tried.seed - 1], "lw": 1.0 + number // 10}
            label = f"{tried.experiment.replace('_', ' ')}, seed {tried.seed}"
            axes.plot(curve.samples / 1e6, curve.rates[rate], label=label, **style)
        axes.set(ylabel="falls per second" if rate == "falls" else f"{rate}, share of serves", xscale="log")
        axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel("control steps, millions")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    figure.savefig(FIGURE, dpi=100)


def main() -> None:
    """Take new metrics over, print, draw."""
    runs = listed()
    for source in map(Path, sys.argv[1:2]):
        for tried in runs:
            if (source / tried.run / "metrics.csv").exists():
                write_slim(source / tried.run / "metrics.csv", tried.file)
    curves = {tried: tried.curve() for tried in runs}
    print(table(curves))
    draw(curves)
    print(f"\nwrote {FIGURE}")


if __name__ == "__main__":
    main()
