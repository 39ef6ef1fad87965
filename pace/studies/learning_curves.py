"""The learning curves of ``docs/results/learning.md``: the default recipe at that time, and the earlier prototype.

Reads ``recipe/return_velocity_seed*.csv`` and ``learning/prototype.csv`` of a folder of results.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from pace.runs.files import write_figure
from pace.runs.metrics import Curve, Milestone, markdown, passage, read_curve

RECIPE = "return_velocity"
MILESTONES = (
    Milestone("falls", 0.1),
    *(Milestone("hits", value) for value in (0.1, 0.5, 0.8)),
    *(Milestone("returns", value) for value in (0.1, 0.5)),
)
PROTOTYPE = {"hits": "hit", "returns": "succ", "falls": "fallps"}  # its columns


def read(results: Path) -> dict[str, Curve]:
    """Curves by name: each seed of the recipe, and the prototype."""
    seeds = sorted((results / "recipe").glob(f"{RECIPE}_seed*.csv"))
    curves = {path.stem.removeprefix(f"{RECIPE}_"): read_curve(path) for path in seeds}
    return curves | {"prototype": read_curve(results / "learning" / "prototype.csv", columns=PROTOTYPE)}


def table(curves: Mapping[str, Curve]) -> str:
    """Millions of control steps to each milestone, as Markdown."""
    rows = []
    for milestone in MILESTONES:
        found = [passage(curve, milestone) for curve in curves.values()]
        rows.append([milestone.label, *(f"{place.samples / 1e6:.1f}" if place else "-" for place in found)])
    return markdown(["M control steps to", *curves], rows)


def draw(curves: Mapping[str, Curve], file: Path) -> Path:
    """Hit, return and fall rates against millions of control steps, as a PNG; returns ``file``."""
    figure = Figure(figsize=(13, 3.8), layout="constrained")
    panels = figure.subplots(1, 3)
    for axes, rate in zip(panels, ("hits", "returns", "falls"), strict=True):
        for name, curve in curves.items():
            style = {"color": "0.5", "linestyle": "--"} if name == "prototype" else {}
            axes.plot(curve.samples / 1e6, curve.rates[rate], label=name, **style)
        title = "falls per second" if rate == "falls" else rate
        axes.set(title=title, xlabel="control steps (millions)", ylim=(0, 1))
        axes.grid(alpha=0.3)
    panels[0].legend()
    write_figure(file, figure, dpi=110)
    return file
