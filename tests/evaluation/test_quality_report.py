"""The tables of the quality of play, from the content of an evaluation's file."""

from __future__ import annotations

import pytest

from pace.evaluation.quality_report import compact_quality_table, mean_power, more_tables, quality_table
from pace.evaluation.text import markdown_table, text_table

PHASE = {"share": 0.5, "joint_speed": 1.25, "power": 100.0, "no_foot": 0.01, "feet_lifted": 2.0}
PHASE |= {"foot_slide": 0.1, "base_speed": 0.2, "lean": 5.0}
SPREAD = {"p5": 1.0, "p50": 2.0, "p95": None}
QUALITY = {
    "height": {"mean": 0.54, "p5": 0.5, "p95": 0.6, "nominal": 0.6646},
    "at_ball": PHASE,
    "after_hit": PHASE | {"share": 0.0, "power": None},
    "waiting": PHASE | {"power": 60.0},
    "sway": 0.012,
    "calm_after_hit": {"p50": 0.2, "p95": None, "never": 0.05},
    "range_end": {"Waist": 0.0, "Right_Hip_Roll": 0.24, "Left_Knee_Pitch": 0.0001, "Right_Elbow_Yaw": 0.3},
    "torque_limit": {"Waist": 0.0},
    "touches": {"head": 0.002},
    "self_contacts": {"left_forearm - trunk": {"share": 0.07, "deepest": 0.045}},
    **dict.fromkeys(("paddle_speed", "speed_out", "net_clearance"), SPREAD),
    "landing": {},
    "thresholds": {"sway_window": 0.5, "edge": 0.1},
}  # fmt: skip


def test_every_line_of_the_table() -> None:
    lines = quality_table({"mixed": QUALITY, "mid_long": QUALITY}, markdown_table).splitlines()
    assert lines[0] == "|  | mixed | mid-long |"
    cells = {line.split(" | ")[0].strip("| "): line.split(" | ")[1] for line in lines[2:]}
    assert cells["height of the base, cm: mean (5 to 95 %) of nominal"] == "54.0 (50.0 to 60.0) of 66.5"
    assert cells["power, W: likewise"] == "100 / - / 60"
    assert cells["sway while waiting, cm: std of the base in 0.5 s"] == "1.20"
    assert cells["calm after a hit, s: median (95 %); never"] == "0.20 (-), 5.0 %"
    assert cells["joints at an end of their range, % of time"] == "right elbow yaw 30.0, right hip roll 24.0"
    assert cells["motors at their limit, % of time"] == "none"
    assert cells["parts inside of one another, % of poses (deepest)"] == "left forearm - trunk 7.0 (4.5 cm)"
    assert cells["speed of the paddle at the hit, m/s: median (5 to 95 %)"] == "2.0 (1.0 to -)"
    assert cells["landings within 0.1 m of an edge, %"] == "-"


def test_the_terminal_has_a_line_for_each_row() -> None:
    lines = compact_quality_table({"mixed": QUALITY}, text_table).splitlines()
    assert len(lines) == 3
    assert "54.0  66.5" in lines[2]
    assert "right elbow yaw 30.0" in lines[2]
    assert mean_power(QUALITY) == pytest.approx(80.0)


def test_an_older_file_has_no_such_tables() -> None:
    assert more_tables({"rows": []}, markdown_table) == []
