"""Tables of success by the ball's number, of the first ball after standing ready, and of the quality of play.

All of them are made from the content of ``evaluation.json``, so that a model card has the same ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pace.evaluation.text import Table, interval, number

Content = Mapping[str, Any]
BY_BALL = "Success by the number of the ball since the start of a world, %, with its 95 % interval:"
FIRST_BALL = "First ball after standing ready ({serve} serves; until then the ball {ball}):"
QUALITY = "Quality of play:"
BALL_DOES = {
    "lies": "lies on the floor below the net, in view",
    "carried": "is carried to the place of the launch",
    "hidden": "is out of view",
}
FIRST_HEADER = ("stood ready, s", "robots", "hit %", "95 %", "success %", "95 %", "falls waiting/1,000", "95 %")
PHASES = ("at_ball", "after_hit", "waiting")
WORST = 3  # joints, motors, bodies or pairs that are named
LEAST = 0.0005  # share of the time from which on one is named


def by_ball_table(groups: Mapping[str, Sequence[Content]], table: Table, compact: bool = False) -> str:
    """A line for the hits and one for the successes of each row; ``compact``: only the successes."""
    balls = list({group["balls"]: None for row in groups.values() for group in row})
    shares = ("success",) if compact else ("hit", "success")
    body = []
    for serve, row in groups.items():
        known = {group["balls"]: group for group in row}
        for share in shares:
            cells = [_share(known[name], share) if name in known else "-" for name in balls]
            body.append([serve if compact else f"{serve}, {share} %", *cells])
    return table((f"{'serve, ' if compact else ''}ball", *balls), body)


def _share(row: Content, name: str) -> str:
    return f"{number(row[name], 100)} ({interval(row, name)})"


def first_ball_table(rows: Sequence[Content], table: Table) -> str:
    """A line for each time."""
    falls = "falls_waiting_per_1000"
    body = [
        [
            f"{row['wait']:g}",
            f"{row['robots']:,}",
            *(text for name in ("hit", "success") for text in (number(row[name], 100), interval(row, name))),
            number(row[falls]),
            interval(row, falls, 1.0),
        ]
        for row in rows
    ]
    return table(FIRST_HEADER, body)


def quality_table(quality: Mapping[str, Content], table: Table) -> str:
    """A line for each measure, a column for each row of the evaluation."""
    first = next(iter(quality.values()))
    body = [
        [label.format(**first["thresholds"]), *(cell(row) for row in quality.values())]
        for label, cell in MEASURES.items()
    ]
    return table(("", *(serve.replace("_", "-") for serve in quality)), body)


def compact_quality_table(quality: Mapping[str, Content], table: Table) -> str:
    """A line for each row of the evaluation, a column for each of the most telling measures."""
    body = [[serve, *(cell(row) for cell in COMPACT.values())] for serve, row in quality.items()]
    return table(("serve", *COMPACT), body)


def _phases(name: str, factor: float = 1.0, digits: int = 2) -> Callable[[Content], str]:
    """The three phases of a mean."""
    return lambda row: " / ".join(number(row[phase][name], factor, digits) for phase in PHASES)


def _spread(name: str, factor: float = 1.0, digits: int = 1) -> Callable[[Content], str]:
    """Median and 90 % range."""

    def cell(row: Content) -> str:
        low, middle, high = (number(row[name][key], factor, digits) for key in ("p5", "p50", "p95"))
        return f"{middle} ({low} to {high})"

    return cell


def _worst(name: str, most: int = WORST) -> Callable[[Content], str]:
    """The largest shares of the time, in per cent, with their names."""

    def cell(row: Content) -> str:
        largest = sorted(row[name].items(), key=lambda item: -item[1])[:most]
        return _listed(f"{key.replace('_', ' ').lower()} {100 * share:.1f}" for key, share in largest if share > LEAST)

    return cell


def _listed(texts: Any) -> str:
    return ", ".join(texts) or "none"


def mean_power(row: Content) -> float:
    """W, over all phases."""
    return sum(row[phase]["share"] * row[phase]["power"] for phase in PHASES if row[phase]["share"])


def _height(row: Content) -> str:
    mean, low, high, nominal = (number(row["height"][key], 100) for key in ("mean", "p5", "p95", "nominal"))
    return f"{mean} ({low} to {high}) of {nominal}"


def _calm(row: Content) -> str:
    calm = row["calm_after_hit"]
    return f"{number(calm['p50'], digits=2)} ({number(calm['p95'], digits=2)}), {number(calm['never'], 100)} %"


def _self_contacts(most: int = WORST) -> Callable[[Content], str]:
    """The pairs that overlap in most poses, in per cent, and by how much at most."""

    def cell(row: Content) -> str:
        found = list(row["self_contacts"].items())[:most]
        return _listed(
            f"{name.replace('_', ' ')} {100 * pair['share']:.1f} ({100 * pair['deepest']:.1f} cm)"
            for name, pair in found
            if pair["share"] > LEAST
        )

    return cell


def _landing(row: Content) -> str:
    found = row["landing"]
    if not found:
        return "-"
    return ", ".join(f"{number(found[axis], digits=2)} ({number(found[f'std_{axis}'], digits=2)})" for axis in "xy")


def _near_edge(row: Content) -> str:
    return number(row["landing"].get("near_edge"), 100)


def _zones(row: Content) -> str:
    zones = row["landing"].get("zones", ())
    return "; ".join(" ".join(number(share, 100, 0) for share in line) for line in zones) or "-"


#: Cells of the table by their labels, which hold thresholds of the configuration.
MEASURES: dict[str, Callable[[Content], str]] = {
    "height of the base, cm: mean (5 to 95 %) of nominal": _height,
    "share of time at the ball / after a hit / waiting, %": _phases("share", 100, 0),
    "joint speed, rms, rad/s: at the ball / after a hit / waiting": _phases("joint_speed"),
    "power, W: likewise": _phases("power", digits=0),
    "no foot on the floor, % of time: likewise": _phases("no_foot", 100),
    "feet lifted, /s: likewise": _phases("feet_lifted"),
    "feet sliding, m/s: likewise": _phases("foot_slide"),
    "speed of the base, m/s: likewise": _phases("base_speed"),
    "lean of the trunk, degrees: likewise": _phases("lean", digits=1),
    "sway while waiting, cm: std of the base in {sway_window:g} s": lambda row: number(row["sway"], 100, 2),
    "calm after a hit, s: median (95 %); never": _calm,
    "joints at an end of their range, % of time": _worst("range_end"),
    "motors at their limit, % of time": _worst("torque_limit"),
    "bodies that touch something, % of time": _worst("touches"),
    "parts inside of one another, % of poses (deepest)": _self_contacts(),
    "speed of the paddle at the hit, m/s: median (5 to 95 %)": _spread("paddle_speed"),
    "speed of the ball after it, m/s: likewise": _spread("speed_out"),
    "air between net and ball, cm: likewise": _spread("net_clearance", 100, 0),
    "landing x, y, m: mean (std)": _landing,
    "landings within {edge:g} m of an edge, %": _near_edge,
    "landings by zone, %: right, middle, left; at the net; at the end": _zones,
}
#: Columns of the compact table.
COMPACT: dict[str, Callable[[Content], str]] = {
    "base cm": lambda row: number(row["height"]["mean"], 100),
    "of": lambda row: number(row["height"]["nominal"], 100),
    "waiting rad/s": lambda row: number(row["waiting"]["joint_speed"], digits=2),
    "sway cm": lambda row: number(row["sway"], 100, 2),
    "feet /s": lambda row: number(row["waiting"]["feet_lifted"]),
    "calm s": lambda row: number(row["calm_after_hit"]["p50"], digits=2),
    "power W": lambda row: number(mean_power(row), digits=0),
    "at the range's end %": _worst("range_end", 1),
    "at the torque limit %": _worst("torque_limit", 1),
    "overlap %": _self_contacts(1),
    "near edge %": _near_edge,
}


def more_tables(content: Content, table: Table, compact: bool = False) -> list[str]:
    """Headings and tables of what ``content`` has, of an ``evaluation.json`` or of that form."""
    parts: list[str] = []
    if content.get("by_ball"):
        parts += [BY_BALL, by_ball_table(content["by_ball"], table, compact)]
    first = content.get("first_ball") or {}
    if first.get("rows"):
        heading = FIRST_BALL.format(serve=first["serve"].replace("_", "-"), ball=BALL_DOES[first["ball"]])
        parts += [heading, first_ball_table(first["rows"], table)]
    if content.get("quality"):
        make = compact_quality_table if compact else quality_table
        parts += [QUALITY, make(content["quality"], table)]
    return parts
