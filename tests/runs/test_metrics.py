"""Milestones on made-up curves whose passages are known in closed form."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pace.runs.metrics import (
    MILESTONES,
    Milestone,
    markdown,
    passage,
    passage_text,
    read_curve,
    read_metrics,
    write_slim,
)

STEP = 10_000  # control steps of a row
WINDOW = 50_000.0
HITS_50 = Milestone("hits", 0.5)
Rate = Callable[[int], float | str]


def write_run(
    file: Path, rows: int = 200, hits: Rate = lambda _: 0.0, falls: Rate = lambda _: 0.0, serves: Rate | None = None
) -> Path:
    """A metrics.csv of rates that are functions of the control steps; 1,000 control steps take a second."""
    lines = ["update,samples,wall_s,hit_rate,success_rate,fall_rate" + (",serves" if serves else "")]
    for row in range(1, rows + 1):
        samples = row * STEP
        cells = [row, samples, samples / 1000.0, hits(samples), 0.0, falls(samples)]
        lines.append(",".join(str(cell) for cell in [*cells, *([serves(samples)] if serves else [])]))
    file.write_text("\n".join(lines) + "\n")
    return file


def test_a_rising_share_passes_half_a_window_late(tmp_path: Path) -> None:
    file = write_run(tmp_path / "m.csv", hits=lambda samples: samples / 2e6)  # 50 % at 1 M
    found = passage(read_curve(file, WINDOW), HITS_50)
    assert found is not None
    assert found.samples == 1_020_000  # the mean of five rows is that of the third
    assert found.minutes == pytest.approx(1020.0 / 60.0)
    assert not found.at_start
    assert passage(read_curve(file, WINDOW), Milestone("hits", 1.01)) is None


def test_points_are_means_over_full_windows_only(tmp_path: Path) -> None:
    curve = read_curve(write_run(tmp_path / "m.csv", rows=10, hits=lambda samples: samples / 1e5), WINDOW)
    assert curve.samples.tolist() == [50_000, 60_000, 70_000, 80_000, 90_000, 100_000]
    np.testing.assert_allclose(curve.rates["hits"], [0.3, 0.4, 0.5, 0.6, 0.7, 0.8])


def test_shares_are_weighted_by_serves_and_empty_cells_left_out(tmp_path: Path) -> None:
    file = write_run(
        tmp_path / "m.csv",
        rows=5,
        hits=lambda samples: {10_000: "", 20_000: 1.0}.get(samples, 0.0),
        falls=lambda samples: samples / 1e5,
        serves=lambda samples: {10_000: 0, 20_000: 30}.get(samples, 10),
    )
    curve = read_curve(file, WINDOW)
    assert curve.rates["hits"] == pytest.approx([30 / 60])
    assert curve.rates["falls"] == pytest.approx([0.3])  # per second of worlds that all play as long


def test_falls_count_from_the_worst_on(tmp_path: Path) -> None:
    def falls(samples: int) -> float:
        return samples / 2e5 if samples <= 200_000 else max(0.0, 1.2 - samples / 1e6)

    curve = read_curve(write_run(tmp_path / "m.csv", falls=falls), WINDOW)
    assert curve.rates["falls"][0] < 1 / 3  # just reset, not fallen yet
    third, tenth = (passage(curve, milestone) for milestone in MILESTONES[:2])
    assert third is not None
    assert tenth is not None
    assert (third.samples, tenth.samples) == (890_000, 1_130_000)  # 1.2 - 1/3 and 1.2 - 0.1 M, and two rows


def test_a_run_that_goes_on_from_another_has_passed_at_its_start(tmp_path: Path) -> None:
    bumpy = write_run(tmp_path / "m.csv", hits=lambda _: 0.6, falls=lambda s: 0.08 if 5e5 < s < 6e5 else 0.02)
    curve = read_curve(bumpy, WINDOW)
    for milestone in (MILESTONES[1], HITS_50):
        found = passage(curve, milestone)
        assert found is not None
        assert found.at_start
        assert passage_text(found) == "from the start"


def test_nothing_counted_is_nothing_passed(tmp_path: Path) -> None:
    curve = read_curve(write_run(tmp_path / "m.csv", hits=lambda _: "", falls=lambda _: ""), WINDOW)
    assert all(passage(curve, m) is None for m in MILESTONES if m.rate != "returns")
    (tmp_path / "head.csv").write_text("update,samples,wall_s,hit_rate,success_rate,fall_rate\n")
    for short in (tmp_path / "head.csv", write_run(tmp_path / "one.csv", rows=1)):
        assert all(passage(read_curve(short, WINDOW), milestone) is None for milestone in MILESTONES)
    assert passage_text(None) == "-"


def test_a_slim_file_keeps_every_serve(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    serves = {STEP * row: int(generator.integers(0, 40)) for row in range(1, 202)}
    hits = {samples: generator.uniform() if count else "" for samples, count in serves.items()}
    source = write_run(tmp_path / "m.csv", 201, hits=lambda s: hits[s], serves=lambda s: serves[s])
    slim = write_slim(source, tmp_path / "slim.csv")
    rows = read_metrics(slim)
    assert len(rows["update"]) == 51
    assert rows["update"][:2] == [4, 8]
    assert rows["samples"][-1] == 201 * STEP
    assert sum(rows["serves"]) == sum(serves.values())
    count = sum(float(hits[s]) * serves[s] for s in serves if hits[s] != "")
    assert sum(h * n for h, n in zip(rows["hit_rate"], rows["serves"], strict=True)) == pytest.approx(count, rel=1e-6)
    whole, pooled = (read_curve(file, 40 * STEP) for file in (source, slim))
    shared = np.isin(whole.samples, pooled.samples)
    np.testing.assert_allclose(whole.rates["hits"][shared][:-1], pooled.rates["hits"][:-1], rtol=1e-6)


def test_texts() -> None:
    assert [m.label for m in MILESTONES][:3] == ["falls < 1/3 /s", "falls < 0.1 /s", "hits 10 %"]
    assert markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
