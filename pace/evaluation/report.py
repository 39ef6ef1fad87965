"""An evaluation as a terminal table, JSON, CSV and Markdown."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pace.config.commands import PaperRow
from pace.evaluation.quality_report import more_tables
from pace.evaluation.records import COLUMNS, FAILURES, by_ball
from pace.evaluation.serves import Row
from pace.evaluation.text import interval, markdown_table, number, text_table
from pace.runs.files import write_whole

JSON, CSV, MARKDOWN, SERVES = "evaluation.json", "evaluation.csv", "evaluation.md", "serves.csv"
FILES = (JSON, CSV, MARKDOWN, SERVES)
UNITS = {
    "hit, success": "shares of serves; _low and _high: 95 % Wilson interval",
    "outbound_speed": "m/s, mean over hits",
    "landing_error": "m, mean distance of successes to the landing target",
    "net_clearance": "m, mean air between net and ball over successes",
    "predictor_rmse_cm": "cm, 3-D error of the predicted apex; by_time: by s before the apex",
    "failures": "serves without success; rim: return off the paddle's rim that failed",
    "by_ball": "the same shares by the number of the ball since the start of a world, with the first balls",
    "first_ball": "of robots that stood ready for wait (s); who falls until then has lost the ball",
    "quality": "m, s, rad/s, W, degrees (lean), /s (feet_lifted), shares of time; p5, p50, p95: percentiles",
}
HEADER = (
    "serve", "serves", "hit %", "95 %", "success %", "95 %", "paper hit %", "success %", "out m/s", "landing cm",
    "net cm", "predictor cm", "falls/1,000",
)  # fmt: skip


def cells(row: Mapping[str, Any], paper: Mapping[str, PaperRow]) -> list[str]:
    """A row under ``HEADER``."""
    published = paper.get(row["serve"])
    return [
        row["serve"],
        f"{row['serves']:,}",
        number(row["hit"], 100),
        interval(row, "hit"),
        number(row["success"], 100),
        interval(row, "success"),
        number(published.hit if published else math.nan, 100),
        number(published.success if published else math.nan, 100),
        number(row["outbound_speed"]),
        number(row["landing_error"], 100),
        number(row["net_clearance"], 100),
        number(row["predictor_rmse_cm"]),
        number(row["falls_per_1000"]),
    ]


def failure_cells(row: Mapping[str, Any]) -> list[str]:
    """Outcomes of the serves without success, in per cent of all."""
    return [row["serve"], *(number(row["failures"][name] / max(row["serves"], 1), 100, 2) for name in FAILURES)]


def error_cells(row: Mapping[str, Any]) -> list[str]:
    """The predictor's error by time to the apex, cm."""
    return [row["serve"], *(number(value) for value in row["predictor_rmse_cm_by_time"].values())]


def bin_label(name: str) -> str:
    """A bin of the predictor's error in words: ``0.1_0.2s`` is "0.1 to 0.2s"."""
    return "after the apex" if name == "after_apex" else name.replace("_", " to ").replace("over to", "over")


def more(rows: Sequence[Row], first_ball: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """What an evaluation's files hold besides the summaries of its rows: rates by the ball's number, the rows of the
    first ball, and the quality of play, if it was measured."""
    content: dict[str, Any] = {"by_ball": {row.serve: by_ball(row.all_records) for row in rows}}
    if first_ball:
        content["first_ball"] = dict(first_ball)
    quality = {row.serve: row.quality for row in rows if row.quality}
    return content | ({"quality": quality} if quality else {})


def tables(
    rows: Sequence[Row],
    paper: Mapping[str, PaperRow],
    markdown: bool = False,
    first_ball: Mapping[str, Any] | None = None,
) -> str:
    """The whole evaluation: rates beside the paper's, then failures, the predictor, and :func:`more`, which is compact
    in the terminal."""
    table = markdown_table if markdown else text_table
    summaries = [row.summary for row in rows]
    bins = [bin_label(name) for name in summaries[0]["predictor_rmse_cm_by_time"]]
    parts = [
        table(HEADER, [cells(row, paper) for row in summaries]),
        "Serves without success by outcome, % of all:",
        table(("serve", *(name.replace("_", " ") for name in FAILURES)), [failure_cells(row) for row in summaries]),
        "Error of the predicted apex, cm, by time before it:",
        table(("serve", *bins), [error_cells(row) for row in summaries]),
        *more_tables(more(rows, first_ball), table, compact=not markdown),
    ]
    return "\n\n".join(parts)


def clean(value: Any) -> Any:
    """A copy for JSON, in which NaN is null."""
    if isinstance(value, float):
        return None if math.isnan(value) else round(value, 6)
    if isinstance(value, Mapping):
        return {key: clean(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [clean(item) for item in value]
    return value


def flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """One level of keys: ``failures/net`` and so on."""
    result: dict[str, Any] = {}
    for key, value in row.items():
        result |= (
            {f"{key}/{name}": item for name, item in value.items()} if isinstance(value, Mapping) else {key: value}
        )
    return result


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Strict JSON, NaN as null."""
    write_whole(path, json.dumps(clean(content), indent=1, allow_nan=False) + "\n")


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One line per row, NaN as an empty cell."""
    flattened = [clean(flat(row)) for row in rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(flattened[0]))
    writer.writeheader()
    writer.writerows(flattened)
    write_whole(path, text.getvalue())


def write_serves(path: Path, rows: Sequence[Row]) -> None:
    """Every counted serve, one per line: its range, then ``COLUMNS``."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(("serve", *COLUMNS))
    for row in rows:
        for record in row.records.tolist():
            writer.writerow([row.serve, *("" if math.isnan(value) else f"{value:.6g}" for value in record)])
    write_whole(path, text.getvalue())


def write_report(
    folder: Path,
    rows: Sequence[Row],
    paper: Mapping[str, PaperRow],
    context: Mapping[str, Any],
    first_ball: Mapping[str, Any] | None = None,
) -> list[Path]:
    """JSON, CSV, Markdown and the single serves in ``folder``; returns the files."""
    files = [folder / name for name in FILES]
    summaries = [row.summary for row in rows]
    seconds = {row.serve: round(row.seconds, 1) for row in rows}
    published = {name: vars(paper[name]) for name in (row.serve for row in rows) if name in paper}
    content = {"rows": summaries, **context, "paper": published, "units": UNITS, "seconds": seconds}
    write_json(files[0], content | more(rows, first_ball))
    write_csv(files[1], summaries)
    title = f"# Evaluation of {context['policy']}\n\n{describe(context)}\n"
    write_whole(files[2], f"{title}\n{tables(rows, paper, markdown=True, first_ball=first_ball)}\n")
    write_serves(files[3], rows)
    return files


def describe(context: Mapping[str, Any]) -> str:
    """The circumstances, in a line."""
    return (
        f"Ball {context['ball']}, engine {context['engine']} at {1000 * context['physics_dt']:g} ms, randomization "
        f"{context['randomization']}, sensing {context['sensing']}, seed {context['seed']}, "
        f"{context['num_worlds']} worlds without episode ends; the first {context['warmup_serves']} serves of each not "
        "counted."
    )
