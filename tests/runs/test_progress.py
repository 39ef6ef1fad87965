"""What a run shows while it trains: what matters most comes first, since a terminal cuts long lines."""

from __future__ import annotations

import math

import pytest

from pace.runs.progress import Progress

ROW = {"samples": 15.86e6, "samples_per_s": 7455.0, "hit_rate": 0.835, "success_rate": 0.666, "fall_rate": 0.027}
WIDTH = 80 - len(" 66%|################| ")  # of a terminal, without the bar


def line(*rows: dict[str, float], capsys: pytest.CaptureFixture[str]) -> str:
    """The line after these rows, without its percentage."""
    progress = Progress(True, 24e6, 0.0)
    for row in rows:
        progress._last_line = -math.inf
        progress.show(ROW | {"predictor_rmse_cm": 8.9, "update": 3873.0} | row)
    return capsys.readouterr().out.splitlines()[-1].split(" | ", 1)[1]


def test_rates_and_the_last_judgement_fit_into_eighty_columns(capsys: pytest.CaptureFixture[str]) -> None:
    plain = line({}, capsys=capsys)
    assert plain[:WIDTH].split(" | ")[1:3] == ["hit 83.5 %", "return 66.6 %"]
    assert plain.endswith("15.86 M samples | 7,455/s | falls 0.027/s | predictor 8.9 cm | update 3873")
    judged = line({"eval_hit": 0.977, "eval_success": 0.914}, {}, capsys=capsys)  # it stays until the next one
    assert "hit 83.5 % | return 66.6 % | judged 98/91 % | 15.86 M" in judged
    assert len(judged.split(" | 15.86")[0]) <= WIDTH


def test_faults_come_before_what_is_bookkeeping(capsys: pytest.CaptureFixture[str]) -> None:
    shown = line({"diverged": 2.0, "skipped": 1.0}, {"diverged": 1.0}, capsys=capsys)
    assert "return 66.6 % | 3 worlds diverged | 1 updates skipped | 15.86 M samples" in shown
