"""Plot the learning curves of ``docs/learning``: python docs/plot_learning.py

Reads ``seed*.csv`` (metrics of the default configuration, see docs/learning.md) and ``prototype.csv`` (the throw-away
prototype that the recipe started from); writes ``docs/figures/learning.png`` and prints the table of milestones.
"""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).resolve().parent
WINDOW = 250_000  # samples that a point of a curve averages over
#: Milestone -> (column, value, whether the curve has to fall below it).
MILESTONES = {
    "falls < 0.1 /s": ("fall", 0.1, True),
    "hits 10 %": ("hit", 0.10, False),
    "hits 50 %": ("hit", 0.50, False),
    "hits 80 %": ("hit", 0.80, False),
    "returns 10 %": ("success", 0.10, False),
    "returns 50 %": ("success", 0.50, False),
}
#: Column of a curve -> its name in metrics.csv and in prototype.csv.
COLUMNS = {"samples": ("samples", "samples"), "hit": ("hit_rate", "hit"), "success": ("success_rate", "succ")}
COLUMNS |= {"fall": ("fall_rate", "fallps")}

Curve = dict[str, NDArray[np.float64]]


def read(path: Path, prototype: bool) -> Curve:
    """Columns samples, hit, success, fall of a CSV, averaged over windows of ``WINDOW`` samples."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    raw = {name: np.array([float(row[names[prototype]] or "nan") for row in rows]) for name, names in COLUMNS.items()}
    bins = (raw["samples"] / WINDOW).astype(int)
    return {name: np.array([np.nanmean(values[bins == b]) for b in np.unique(bins)]) for name, values in raw.items()}


def reached(curve: Curve, column: str, value: float, below: bool) -> str:
    """Samples (M) at which the curve crosses ``value`` for good enough, or a dash.

    For a curve that has to fall, its start does not count: robots that were just reset have not fallen yet.
    """
    fine = (curve[column] < value) & (curve["samples"] > 1e6) if below else curve[column] >= value
    return f"{curve['samples'][fine.argmax()] / 1e6:.1f}" if fine.any() else "-"


def print_table(curves: dict[str, Curve]) -> None:
    """Millions of samples to each milestone, as Markdown."""
    print("| M samples to | " + " | ".join(curves) + " |\n|---|" + "---|" * len(curves))
    for milestone, condition in MILESTONES.items():
        print(f"| {milestone} | " + " | ".join(reached(curve, *condition) for curve in curves.values()) + " |")


def plot(curves: dict[str, Curve], path: Path) -> None:
    """Hit, return and fall rates against samples."""
    panels = (("hit", "hits"), ("success", "returns"), ("fall", "falls per second"))
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), constrained_layout=True)
    for axis, (column, title) in zip(axes, panels, strict=True):
        for name, curve in curves.items():
            style = {"color": "0.5", "linestyle": "--"} if name == "prototype" else {}
            axis.plot(curve["samples"] / 1e6, curve[column], label=name, **style)
        axis.set(title=title, xlabel="control steps (millions)", ylim=(0, 1))
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Read, print, plot."""
    curves = {path.stem: read(path, False) for path in sorted((HERE / "learning").glob("seed*.csv"))}
    curves["prototype"] = read(HERE / "learning" / "prototype.csv", True)
    print_table(curves)
    target = HERE / "figures" / "learning.png"
    target.parent.mkdir(exist_ok=True)
    plot(curves, target)
    print(f"wrote {target}")


if __name__ == "__main__":
    main()
