"""Plot the learning curves of docs/learning.md: python -m docs.plot_learning

Reads ``recipe/return_velocity_seed*.csv`` (metrics of the default configuration, which ``docs.plot_recipe`` takes over)
and ``learning/prototype.csv`` (the throw-away prototype that the recipe came from); writes
``docs/figures/learning.png`` and prints the table of milestones.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

from pace.runs.metrics import Curve, Milestone, markdown, passage, read_curve

matplotlib.use("Agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).resolve().parent
MILESTONES = (
    Milestone("falls", 0.1),
    *(Milestone("hits", value) for value in (0.1, 0.5, 0.8)),
    *(Milestone("returns", value) for value in (0.1, 0.5)),
)
PROTOTYPE = {"hits": "hit", "returns": "succ", "falls": "fallps"}  # its columns


def print_table(curves: dict[str, Curve]) -> None:
    """Millions of samples to each milestone, as Markdown."""
    rows = []
    for milestone in MILESTONES:
        found = [passage(curve, milestone) for curve in curves.values()]
        rows.append([milestone.label, *(f"{place.samples / 1e6:.1f}" if place else "-" for place in found)])
    print(markdown(["M samples to", *curves], rows))


def plot(curves: dict[str, Curve], path: Path) -> None:
    """Hit, return and fall rates against samples."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), constrained_layout=True)
    for axis, rate in zip(axes, ("hits", "returns", "falls"), strict=True):
        for name, curve in curves.items():
            style = {"color": "0.5", "linestyle": "--"} if name == "prototype" else {}
            axis.plot(curve.samples / 1e6, curve.rates[rate], label=name, **style)
        title = "falls per second" if rate == "falls" else rate
        axis.set(title=title, xlabel="control steps (millions)", ylim=(0, 1))
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Read, print, plot."""
    seeds = sorted((HERE / "recipe").glob("return_velocity_seed*.csv"))
    curves = {path.stem.removeprefix("return_velocity_"): read_curve(path) for path in seeds}
    curves["prototype"] = read_curve(HERE / "learning" / "prototype.csv", columns=PROTOTYPE)
    print_table(curves)
    target = HERE / "figures" / "learning.png"
    target.parent.mkdir(exist_ok=True)
    plot(curves, target)
    print(f"wrote {target}")


if __name__ == "__main__":
    main()
