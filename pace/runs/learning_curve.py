"""The learning curve of a run, drawn from its CSV."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from pace.runs.files import reason, say, write_figure
from pace.runs.metrics import read_metrics

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CURVE = "learning_curve.png"
CURVE_WINDOW = 40  # rows of the moving average in the plot
#: Label of each panel, and its curves: column, name, factor. Those that begin with ``eval_`` are few: judgements.
PANELS = (
    (
        "share of serves, %",
        (
            ("hit_rate", "hits", 100.0),
            ("success_rate", "returns", 100.0),
            ("eval_hit", "hits without exploration", 100.0),
            ("eval_success", "returns without exploration", 100.0),
        ),
    ),
    ("falls per s", (("fall_rate", "falls", 1.0),)),
    ("predictor RMSE, cm", (("predictor_rmse_cm", "apex", 1.0),)),
    ("policy std", (("policy_std", "std", 1.0),)),
)


def moving_average(values: list[float], window: int) -> list[float]:
    """Mean of the last ``window`` values that are not NaN, at each position."""
    result: list[float] = []
    for end in range(1, len(values) + 1):
        recent = [value for value in values[max(0, end - window) : end] if not math.isnan(value)]
        result.append(sum(recent) / len(recent) if recent else math.nan)
    return result


def _draw(axes: Axes, millions: list[float], values: list[float], name: str, dots: bool) -> None:
    """A moving average; or ``dots``, values that are far apart."""
    if not dots:
        axes.plot(millions, moving_average(values, CURVE_WINDOW), label=name)
        return
    known = [(x, value) for x, value in zip(millions, values, strict=True) if not math.isnan(value)]
    if known:
        axes.plot(*zip(*known, strict=True), "o--", markersize=4, linewidth=1, label=name)


def plot_learning_curve(run: str | Path) -> Path | None:
    """Draw ``learning_curve.png`` from the run's CSV; None when it has fewer than two rows, or cannot be written."""
    from matplotlib.figure import Figure  # imported here: it takes a second that no training should wait for

    csv = Path(run) / "metrics.csv"
    metrics = read_metrics(csv) if csv.is_file() else {}
    if len(metrics.get("update", [])) < 2:
        return None
    millions = [samples / 1e6 for samples in metrics["samples"]]
    figure = Figure(figsize=(9, 10), layout="constrained")
    for axes, (label, curves) in zip(figure.subplots(len(PANELS), 1, sharex=True), PANELS, strict=True):
        for column, name, factor in curves:
            if column in metrics:
                _draw(axes, millions, [factor * value for value in metrics[column]], name, column.startswith("eval_"))
        axes.set_ylabel(label)
        axes.update_datalim([(millions[0], 0.0)])  # zero is in view, the upper margin a share of the whole height
        axes.autoscale_view()
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(loc="best")
    axes.set_xlabel(f"control steps, millions (mean of {CURVE_WINDOW} updates)")
    file = Path(run) / CURVE
    try:
        write_figure(file, figure, dpi=110)
    except OSError as error:
        say(f"warning: {file} cannot be written: {reason(error)}")
        return None
    return file
