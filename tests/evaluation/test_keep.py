"""A kept policy: the same actions, no training state, nothing of the machine that trained it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from pace.evaluation.keep import keep, main
from pace.rl.policies import load_policy
from tests.helpers.saved import save_run

ROW = {"serve": "mid_long", "serves": 5120, "hit": 0.995, "hit_low": 0.991, "hit_high": 0.997}
ROW |= {"success": 0.971, "success_low": 0.965, "success_high": 0.976, "falls_per_1000": 0.39}
EVALUATED = {
    "rows": [ROW], "physics_dt": 0.002, "num_worlds": 256, "warmup_serves": 2, "seed": 1,
    "overrides": ["engine.physics_dt=0.002", "engine.threads=1", "sensing=paper"],
}  # fmt: skip


def test_the_kept_policy_acts_like_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = save_run(tmp_path / "run")
    (run / "metrics.csv").write_text("update,samples\n3,99\n")
    evaluation = tmp_path / "evaluation"
    evaluation.mkdir()
    (evaluation / "evaluation.json").write_text(json.dumps(EVALUATED))
    (evaluation / "sweep.json").write_text(json.dumps({"cells": [{"kind": "noise", "value": "x 2", "rows": [ROW]}]}))
    (tmp_path / "notes.md").write_text("Made by a test.\n")
    kept = tmp_path / "pretrained" / "mine"
    extra = ["--evaluation", str(evaluation), "--notes", str(tmp_path / "notes.md")]
    assert main([str(run), str(kept), *extra]) == 0
    assert "metrics.csv" in capsys.readouterr().out
    names = {file.name for file in kept.iterdir()}
    files = {"checkpoint.json", "weights.safetensors", "metrics.csv", "evaluation.json", "sweep.json", "README.md"}
    assert names == files | {"versions.json"} & names
    before, after = load_policy(run), load_policy(kept)
    observation = torch.randn(5, 450)
    torch.testing.assert_close(after(observation), before(observation), atol=1e-6, rtol=0)
    assert (after.config.engine.name, after.config.engine.threads, after.config.run_dir) == ("auto", 0, None)


def test_the_card_says_what_it_is_and_how_to_play_its_table(tmp_path: Path) -> None:
    run = save_run(tmp_path / "run")
    (tmp_path / "run" / "versions.json").write_text(
        json.dumps({"command": ["train.py", "experiment=generalist"], "packages": {"torch": "2.13.0", "pace": None}})
    )
    (tmp_path / "evaluation.json").write_text(json.dumps(EVALUATED))
    keep(run, tmp_path / "mine", tmp_path, "It limps.")
    text = (tmp_path / "mine" / "README.md").read_text()
    assert text.startswith("# mine\n")
    assert "`ball=rubber`" in text
    assert "| last command | `python -m pace.rl.train experiment=generalist` |" in text
    assert "| versions | torch 2.13.0 |" in text
    assert "\nIt limps.\n" in text
    command = "physics_dt=0.002 num_worlds=256 warmup_serves=2 seed=1 serves=5120 sensing=paper"
    assert f"`python -m pace.evaluation pretrained/mine {command}`" in text
    assert "| mid-long | 5,120 | 99.5 (99.1 to 99.7) | 97.1 (96.5 to 97.6) | 0.4 |" in text
    assert "What it survives" not in text


@pytest.mark.parametrize("case", ["no run", "no evaluation", "no notes"])
def test_wrong_folders_are_one_line(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "nothing" if case == "no run" else save_run(tmp_path / "run")
    extra = ["--evaluation", str(tmp_path)] if case == "no evaluation" else []
    extra += ["--notes", str(tmp_path / "none.md")] if case == "no notes" else []
    assert main([str(run), str(tmp_path / "kept"), *extra]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "kept").exists()
