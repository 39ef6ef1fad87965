"""Figures of an evaluation: strike points, landing points, paths of the base, and the robustness sweep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from pace.config.ball import TableConfig
from pace.evaluation.records import C, rates
from pace.evaluation.serves import PATH_STEPS, Row
from pace.runs.files import write_figure
from pace.task.game import Outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
    from matplotlib.legend import Legend

STRIKES, LANDINGS, FOOTWORK, BALLS = "strike_map.png", "landing_map.png", "footwork.png", "by_ball.png"
FIGURES = (STRIKES, LANDINGS, FOOTWORK, BALLS)
#: Serve ranges by speed, m/s, as in the paper's table II: label, fastest and slowest vx, colour.
SPEED_CLASSES = (
    ("long, 6.2 to 6.5 m/s", -6.5, -6.2, "tab:red"),
    ("mid-long, 5.7 to 6.2 m/s", -6.2, -5.7, "tab:orange"),
    ("short, 5.2 to 5.7 m/s", -5.7, -5.2, "tab:blue"),
)
DOTS_PER_CLASS = 1500  # more would overlap
LANDING_COLOURS = {
    Outcome.SUCCESS: "tab:green",
    Outcome.OUT: "tab:red",
    Outcome.NET: "tab:purple",
    Outcome.OWN_SIDE: "tab:orange",
}
AREA_X, AREA_Y, HEIGHTS = (-2.6, -1.2), (-1.15, 1.15), (0.4, 1.6)  # m, the robot's end
STRIKE_LEGEND = "speed of the serve (successes); hollow: hit without success; light blue, black: table"
LANDING_X, LANDING_Y = (-1.6, 3.2), (-1.6, 1.6)  # m
TABLE_COLOUR = "#c9dcec"
DARK = 42.0  # per cent from the middle of the heat map: black letters are unreadable beyond it
DPI = 120


def new_figure(width: float, height: float) -> Figure:
    """A figure without a window."""
    from matplotlib.figure import Figure  # slow to import

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
    """Strike points of successful returns, from above and from the side, by speed of the serve.

    Figure 5 of the paper; hits without success are hollow.
    """
    figure = new_figure(9.0, 7.9)
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
    _draw_table(above, table)
    side.plot([edge, 0.0], [table.height, table.height], color="black", linewidth=2)
    above.set(xlabel="x, m (towards the opponent)", ylabel="y, m (to the robot's left)", ylim=AREA_Y)
    above.set_title("strike points from above")
    side.set(xlabel="x, m (towards the opponent)", ylabel="z, m", title="from the side", ylim=HEIGHTS)
    _finish(above, side)
    for axes in (above, side):
        axes.set_xlim(*AREA_X)
    handles, labels = side.get_legend_handles_labels()
    _legend_dots(figure.legend(handles, labels, loc="outside lower center", ncols=3, title=STRIKE_LEGEND))
    return figure


def landing_map(rows: Sequence[Row], table: TableConfig, target: tuple[float, float]) -> Figure:
    """Landing points of returns, on the table seen from above."""
    figure = new_figure(9.0, 7.3)
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
    axes.plot(*target, marker="+", color="black", markersize=12, linestyle="none", label="landing target")
    axes.set(xlabel="x, m (towards the opponent)", ylabel="y, m (to the robot's left)", xlim=LANDING_X, ylim=LANDING_Y)
    axes.set_title(f"where returns came down first, table from above ({_beyond(records)} beyond the picture)")
    _finish(axes)
    _legend_dots(figure.legend(loc="outside lower center", ncols=3))
    return figure


def _beyond(records: Tensor) -> int:
    """Number of returns that landed outside of the map."""
    shown = torch.tensor([float(outcome) for outcome in LANDING_COLOURS])
    x, y = column(records, "landing_x"), column(records, "landing_y")
    outside = (x < LANDING_X[0]) | (x > LANDING_X[1]) | (y < LANDING_Y[0]) | (y > LANDING_Y[1])
    return int((outside & torch.isin(column(records, "outcome"), shown)).sum())


def footwork(rows: Sequence[Row], table: TableConfig) -> Figure:
    """Paths of the base on the floor, some worlds of each row; the colour is the number of the serve in its world."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(1.6 + 2.9 * len(rows), 5.0)
    last = max(float(row.path[..., 2].nan_to_num(0.0).max()) for row in rows)
    colours = ScalarMappable(cmap="viridis")
    colours.set_clim(1.0, max(last, 1.0) + 1.0)
    panels = figure.subplots(1, len(rows), squeeze=False, sharey=True)[0]
    for axes, row in zip(panels, rows, strict=True):
        for world in range(row.path.shape[1]):
            path = row.path[:, world]
            for serve in path[:, 2].unique().tolist():
                piece = path[path[:, 2] == serve]
                axes.plot(piece[:, 0], piece[:, 1], color=colours.to_rgba(serve + 1.0), linewidth=1, alpha=0.8)
        start = row.path[0]
        axes.plot(start[:, 0], start[:, 1], linestyle="none", marker="o", color="tab:red", markersize=4)
        _draw_table(axes, table)
        axes.set(xlabel="x, m", title=f"{row.serve.replace('_', '-')} serves", xlim=AREA_X, ylim=AREA_Y)
        _finish(axes)
    panels[0].set_ylabel("y, m (to the robot's left)")
    figure.colorbar(colours, ax=panels, shrink=0.8, label="serve of the world", ticks=MaxNLocator(integer=True))
    worlds = rows[0].path.shape[1]
    title = f"paths of the base: {worlds} worlds, {PATH_STEPS} control steps; red: where they begin; blue: table"
    figure.suptitle(title, fontsize="medium")
    return figure


def ball_figure(rows: Sequence[Row], warmup_serves: int) -> Figure:
    """Success by the number of the ball since the start of a world, with its 95 % interval, a line for each row.

    The first ``warmup_serves`` balls, which the table leaves out, are grey.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(7.5, 4.2)
    axes = figure.subplots()
    for row in rows:
        numbers, low, middle, high = success_by_ball(row.all_records)
        axes.plot(numbers, middle, marker="o", markersize=3, label=row.serve.replace("_", "-"))
        axes.fill_between(numbers, low, high, alpha=0.2, linewidth=0)
    if warmup_serves:
        axes.axvspan(0.5, warmup_serves + 0.5, color="0.9", zorder=0)
    axes.set(xlabel="number of the ball since the start of its world (grey: not in the table)", ylabel="success, %")
    axes.set_title("success by ball, with its 95 % interval")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def success_by_ball(records: Tensor) -> tuple[list[int], list[float], list[float], list[float]]:
    """Numbers of the balls of ``records``; lower bound, share and upper bound of success of each, in per cent."""
    numbers = column(records, "ball").unique().long().tolist()
    found = [rates(records[column(records, "ball") == number]) for number in numbers]
    low, middle, high = ([100.0 * row[key] for row in found] for key in ("success_low", "success", "success_high"))
    return numbers, low, middle, high


def heat_map(labels: Sequence[tuple[str, str]], tables: Sequence[Sequence[Mapping[str, Any]]], title: str) -> Figure:
    """Hits and successes in per cent, with half of their 95 % interval: a line for each label (kind of change, text), a
    column for each serve range. ``tables`` holds the summaries of the rows of each line."""
    names = [row["serve"].replace("_", "-") for row in tables[0]]
    figure = new_figure(4.6 + 1.7 * len(names), 1.9 + 0.28 * len(labels))
    panels = figure.subplots(1, 2, sharey=True, squeeze=False)[0]
    breaks = [y - 0.5 for y in range(1, len(labels)) if labels[y][0] != labels[y - 1][0]]
    images = [_heat_panel(axes, share, tables) for axes, share in zip(panels, ("hit", "success"), strict=True)]
    for axes in panels:
        axes.hlines(breaks, -0.5, len(names) - 0.5, color="white", linewidth=3)
        axes.set(xlabel="serves", xticks=range(len(names)), xticklabels=names)
        axes.set_yticks(range(len(labels)), [text for _, text in labels])
        axes.tick_params(length=0)
    figure.colorbar(images[0], ax=panels, shrink=0.8, label="% of serves")
    figure.suptitle(f"{title}\n± half of the 95 % interval", fontsize="medium", wrap=True)
    return figure


def _heat_panel(axes: Axes, share: str, tables: Sequence[Sequence[Mapping[str, Any]]]) -> AxesImage:
    """One share of all cells, with half of its interval."""
    per_cent = [[100.0 * row[share] for row in rows] for rows in tables]
    image = axes.imshow(per_cent, vmin=0, vmax=100, cmap="RdYlGn", aspect="auto")
    for y, rows in enumerate(tables):
        for x, row in enumerate(rows):
            text = f"{per_cent[y][x]:.1f} ±{50 * (row[f'{share}_high'] - row[f'{share}_low']):.1f}"
            colour = "white" if abs(per_cent[y][x] - 50.0) > DARK else "black"
            axes.text(x, y, text, ha="center", va="center", fontsize="small", color=colour)
    axes.set_title(f"{share}, %")
    return image


def _draw_table(axes: Axes, table: TableConfig) -> None:
    """The table from above, to scale, with its net."""
    x, y = 0.5 * table.length, 0.5 * table.width
    axes.fill([-x, x, x, -x], [-y, -y, y, y], color=TABLE_COLOUR, edgecolor="black", linewidth=1.2, zorder=0)
    net = (-y - table.net_overhang, y + table.net_overhang)
    axes.plot([0, 0], net, color="black", linewidth=2.5, zorder=1)


def _legend_dots(legend: Legend) -> None:
    """Make the dots of a legend large and opaque."""
    from matplotlib.collections import PathCollection

    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):
            handle.set(sizes=[30.0], alpha=1.0)


def _finish(*panels: Axes) -> None:
    for axes in panels:
        axes.set_aspect("equal")
        axes.grid(alpha=0.3)


def write_figures(
    folder: Path, rows: Sequence[Row], table: TableConfig, target: tuple[float, float], warmup_serves: int
) -> list[Path]:
    """Draw the figures of an evaluation in ``folder``; returns the files."""
    figures = {
        STRIKES: strike_map(rows, table),
        LANDINGS: landing_map(rows, table, target),
        FOOTWORK: footwork(rows, table),
        BALLS: ball_figure(rows, warmup_serves),
    }
    for name, figure in figures.items():
        write_figure(folder / name, figure, dpi=DPI)
    return [folder / name for name in figures]
