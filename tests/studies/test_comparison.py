"""``pace compare``: seeds of one configuration are one curve, intervals of their means, and the command itself."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from pace.config.base import to_dict
from pace.runs.metrics import Curve
from pace.runs.own_files import LIST
from pace.studies.compare import main
from pace.studies.comparison import STUDENT, mean_interval, rate_table
from pace.studies.run_groups import differences, group_runs, read_run
from tests.helpers.outside import command
from tests.helpers.saved import make_config, save_run


def write_run(folder: Path, seed: int, level: float, **changes: object) -> Path:
    """A run folder without a checkpoint: its configuration, and metrics that rise to ``level`` of hits."""
    folder.mkdir(parents=True)
    config = to_dict(make_config()) | {"seed": seed, "out": str(folder), "processes": seed} | changes
    (folder / "config.yaml").write_text(f"# format: 5\n{yaml.safe_dump(config)}")
    with (folder / "metrics.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("update", "samples", "wall_s", "hit_rate", "success_rate", "fall_rate", "serves"))
        for update in range(1, 101):
            share = level * min(1.0, update / 50)
            writer.writerow((update, 20_000 * update, 3 * update, share, share / 2, 1.0 - share, 100))
    return folder


def test_seeds_of_one_configuration_are_one_group(tmp_path: Path) -> None:
    paths = [write_run(tmp_path / f"2026-01-0{seed}_10-00-00_mine_seed{seed}", seed, 0.8) for seed in (1, 2)]
    paths.append(write_run(tmp_path / "other", 1, 0.8, physics_dt_of_mine=0.01, samples=2e6))
    paths.append(Path("docs/results/recipe/steps_12_seed1.csv"))
    paths.append(Path("docs/results/recipe/steps_12_seed2.csv"))
    groups = group_runs([read_run(str(path)) for path in paths])
    assert {name: len(members) for name, members in groups.items()} == {"mine": 2, "other": 1, "steps_12": 2}
    told = differences(groups)
    assert "physics_dt_of_mine=0.01" in told["other"]
    assert "samples=2000000.0" in told["other"]
    assert "seed" not in told["other"] + told["mine"]
    assert told["steps_12"] == ""


def curve(level: float) -> Curve:
    samples = np.linspace(1e6, 5e6, 20)
    flat = np.full(20, level)
    return Curve(samples, samples / 1e6, {"hits": flat, "returns": 0.5 * flat, "falls": 1.0 - flat})


def test_the_table_has_the_interval_of_the_mean_over_seeds() -> None:
    stats = pytest.importorskip("scipy.stats")
    values = [0.6, 0.7, 0.65]
    head, (row, single) = rate_table({"mine": [curve(value) for value in values], "one": [curve(0.5)]})
    low, high = stats.t.interval(0.95, 2, np.mean(values), stats.sem(values))
    assert row[head.index("hits, %, at 5 M")] == f"65.0 ({100 * low:.1f} to {100 * high:.1f})"
    assert single[head.index("hits, %, at 5 M")] == "50.0"
    assert single[head.index("falls, /s, at 5 M")] == "0.500"
    assert row[1] == "3"
    assert stats.t.ppf(0.975, range(1, len(STUDENT) + 1)) == pytest.approx(STUDENT, abs=6e-4)
    mean, half = mean_interval([1.0, 3.0])
    assert (mean, half) == (2.0, pytest.approx(12.706, abs=1e-3))


def test_curves_are_drawn_with_their_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [write_run(tmp_path / f"mine_seed{seed}", seed, 0.6 + 0.1 * seed) for seed in (1, 2)]
    out = tmp_path / "out"
    assert command(main, *map(str, runs), "play=false", f"out={out}") == 0
    printed = capsys.readouterr().out
    assert {file.name for file in out.iterdir()} == {"compare.md", "compare.json", "compare.png", LIST}
    assert "75.0 (11.5 to 100.0)" in printed  # 12.706 standard errors, of at most 100 %
    assert "75.0 (11.5 to 100.0)" in (out / "compare.md").read_text()
    assert (out / "compare.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_two_policies_play_the_same_serves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [str(save_run(tmp_path / name)) for name in ("a", "b")]
    small = ["serves=4", "num_worlds=2", "warmup_serves=0", "physics_dt=0.02", "progress=false", "device=cpu"]
    assert command(main, *runs, f"out={tmp_path / 'out'}", "serve=short", *small) == 2
    assert "rows= names the serve ranges" in capsys.readouterr().err
    assert command(main, *runs, f"out={tmp_path / 'out'}", "ball=paper", "engine.threads=1", *small) == 0
    printed = capsys.readouterr().out
    assert printed.count("ball=paper") == 2
    pairs = json.loads((tmp_path / "out" / "compare.json").read_text())["paired"]["mixed"]
    assert pairs["hit"]["serves"] == pairs["success"]["serves"] == 4
    assert pairs["hit"]["only"] == [0, 0]  # both are the same policy
    assert pairs["hit"]["p_value"] == 1.0
    assert "| mixed, hit | 4 |" in (tmp_path / "out" / "compare.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        ((), 2, "which runs?"),
        (("/nowhere", "a"), 1, "/nowhere does not exist"),
        (("pretrained/pace", "pretrained/pace"), 2, "is given twice"),
        (("pretrained/pace", "window=1e12"), 2, "nothing to compare"),
        (("pretrained/pace", "pretrained/wide", "rows=[lob]"), 2, "serve/lob does not exist"),
        (("pretrained/pace", "window=-1"), 2, "window must be above 0"),
        (("pretrained/pace", "figure=a.pdf"), 2, "must end in .png"),
    ],
)
def test_bad_input_is_one_line(
    arguments: tuple[str, ...],
    status: int,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["compare", *arguments])
    assert main() == status
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: ")
    assert words in error
