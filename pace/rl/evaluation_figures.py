"""Figures of an evaluation: where the paddle met the ball, where returns landed, how the base moved, what survives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pace.config import TableConfig
from pace.rl.evaluation import C, Row
from pace.rl.task import Outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STRIKES, LANDINGS, FOOTWORK = "strike_map.png", "landing_map.png", "footwork.png"
#: Serve ranges by speed, m/s, as in the paper's table I: label, fastest and slowest vx, colour.
SPEED_CLASSES = (
    ("long, 6.2 to 6.5 m/s", -6.5, -6.2, "tab:red"),
    ("mid-long, 5.7 to 6.2 m/s", -6.2, -5.7, "tab:orange"),
    ("short, 5.2 to 5.7 m/s", -5.7, -5.2, "tab:blue"),
)
DOTS_PER_CLASS = 1500  # more would only cover each other
LANDING_COLOURS = {
    Outcome.SUCCESS: "tab:green",
    Outcome.OUT: "tab:red",
    Outcome.NET: "tab:purple",
    Outcome.OWN_SIDE: "tab:orange",
}
AREA_X, AREA_Y, HEIGHTS = (-2.7, -1.1), (-1.15, 1.15), (0.3, 1.8)  # m, the robot's end
STRIKE_LEGEND = "speed of the serve (successes); hollow: hit without success; black: table"
DPI = 120


def new_figure(width: float, height: float) -> Figure:
    """A figure without a window."""
    from matplotlib.figure import Figure  # takes a second that no evaluation should wait for

    return Figure(figsize=(width, height), layout="constrained")


def all_records(rows: Sequence[Row]) -> Tensor:
    """Serves of all rows (M, columns)."""
    return torch.cat([row.records for row in rows])


def column(records: Tensor, name: str) -> Tensor:
    """A column of records by name."""
    return records[:, C[name]]


def thinned(records: Tensor, most: int) -> Tensor:
    """Every k-th of ``records``, so that about ``most`` are left."""
    return records[:: max(1, -(-len(records) // most))]


def strike_map(rows: Sequence[Row], table: TableConfig) -> Figure:
    """Where the paddle met the ball in successful returns, from above and from the side, by speed of the serve.

    Figure 5 of the paper; hits without success are hollow.
    """
    figure = new_figure(11.0, 6.5)
    above, side = figure.subplots(1, 2)
    records = all_records(rows)
    speed = column(records, "serve_vx")
    for label, fastest, slowest, colour in SPEED_CLASSES:
        hits = records[(speed >= fastest) & (speed < slowest) & (column(records, "hit") > 0)]
        successes = int((column(hits, "outcome") == Outcome.SUCCESS).sum())
        chosen = thinned(hits, DOTS_PER_CLASS)
        good = column(chosen, "outcome") == Outcome.SUCCESS
        for axes, vertical in ((above, "strike_y"), (side, "strike_z")):
            x, y = column(chosen, "strike_x"), column(chosen, vertical)
            axes.scatter(x[~good], y[~good], s=9, facecolors="none", edgecolors=colour, linewidths=0.4, alpha=0.5)
            axes.scatter(x[good], y[good], s=7, color=colour, alpha=0.5, linewidths=0, label=f"{label} ({successes:,})")
    edge = -0.5 * table.length
    above.plot([edge, edge], [-0.5 * table.width, 0.5 * table.width], color="black", linewidth=2)
    side.plot([edge, 0.0], [table.height, table.height], color="black", linewidth=2)
    above.set(xlabel="x, m", ylabel="y, m (to the robot's left)", title="strike points from above", ylim=AREA_Y)
    side.set(xlabel="x, m (towards the opponent)", ylabel="z, m", title="from the side", ylim=HEIGHTS)
    _finish(above, side)
    for axes in (above, side):
        axes.set_xlim(*AREA_X)
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3, title=STRIKE_LEGEND)
    return figure


def landing_map(rows: Sequence[Row], table: TableConfig, target: tuple[float, float]) -> Figure:
    """Where returns came down, on the table seen from above."""
    figure = new_figure(9.0, 5.5)
    axes = figure.subplots()
    records = all_records(rows)
    _draw_table(axes, table)
    for outcome, colour in LANDING_COLOURS.items():
        returns = records[column(records, "outcome") == outcome]
        chosen = thinned(returns, 2 * DOTS_PER_CLASS)
        label = f"{outcome.name.lower().replace('_', ' ')} ({len(returns):,})"
        axes.scatter(
            column(chosen, "landing_x"),
            column(chosen, "landing_y"),
            s=7,
            color=colour,
            alpha=0.5,
            linewidths=0,
            label=label,
        )
    axes.plot(*target, marker="+", color="black", markersize=12, linestyle="none", label="target")
    axes.set(xlabel="x, m", ylabel="y, m", title="landing points of returns", xlim=(-1.6, 3.2), ylim=(-1.6, 1.6))
    axes.legend(loc="upper right", fontsize="small")
    _finish(axes)
    return figure


def footwork(rows: Sequence[Row], table: TableConfig) -> Figure:
    """Paths of the base on the floor, some worlds of each row; colour runs with the serves of a world."""
    from matplotlib import colormaps

    figure = new_figure(4.2 * len(rows), 4.6)
    colours = colormaps["viridis"]
    for axes, row in zip(figure.subplots(1, len(rows), squeeze=False)[0], rows, strict=True):
        last = float(row.path[..., 2].nan_to_num(0.0).max())
        for world in range(row.path.shape[1]):
            path = row.path[:, world]
            for serve in path[:, 2].unique().tolist():
                piece = path[path[:, 2] == serve]
                axes.plot(piece[:, 0], piece[:, 1], color=colours(serve / max(last, 1.0)), linewidth=1, alpha=0.8)
        edge = -0.5 * table.length
        axes.plot([edge, edge], [-0.5 * table.width, 0.5 * table.width], color="black", linewidth=2)
        title = f"base, {row.serve.replace('_', '-')}: {row.path.shape[1]} worlds"
        axes.set(xlabel="x, m", ylabel="y, m", title=title, xlim=AREA_X, ylim=AREA_Y)
        _finish(axes)
    return figure


def heat_map(labels: Sequence[str], rows: Sequence[str], values: dict[str, list[list[float]]]) -> Figure:
    """Shares in per cent: a line for each label, a column for each of ``rows``, a panel for each of ``values``."""
    figure = new_figure(2.6 + len(values) * (0.8 + 0.85 * len(rows)), 1.3 + 0.3 * len(labels))
    for axes, (title, table) in zip(
        figure.subplots(1, len(values), sharey=True, squeeze=False)[0], values.items(), strict=True
    ):
        per_cent = [[100.0 * value for value in line] for line in table]
        image = axes.imshow(per_cent, vmin=0, vmax=100, cmap="RdYlGn", aspect="auto")
        for y, line in enumerate(per_cent):
            for x, value in enumerate(line):
                axes.text(x, y, f"{value:.0f}", ha="center", va="center", fontsize="small")
        axes.set_title(f"{title}, %")
        axes.set_xticks(range(len(rows)), [name.replace("_", "-") for name in rows], rotation=30, ha="right")
        axes.set_yticks(range(len(labels)), labels)
        figure.colorbar(image, ax=axes, shrink=0.6)
    return figure


def _draw_table(axes: Axes, table: TableConfig) -> None:
    x, y = 0.5 * table.length, 0.5 * table.width
    axes.plot([-x, x, x, -x, -x], [-y, -y, y, y, -y], color="black", linewidth=1.5)
    axes.plot([0, 0], [-y - table.net_overhang, y + table.net_overhang], color="black", linewidth=2.5)


def _finish(*panels: Axes) -> None:
    for axes in panels:
        axes.set_aspect("equal")
        axes.grid(alpha=0.3)


def write_figures(folder: Path, rows: Sequence[Row], table: TableConfig, target: tuple[float, float]) -> list[Path]:
    """Draw the three figures of an evaluation in ``folder``; returns the files."""
    figures = {
        STRIKES: strike_map(rows, table),
        LANDINGS: landing_map(rows, table, target),
        FOOTWORK: footwork(rows, table),
    }
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=DPI)
    return [folder / name for name in figures]
