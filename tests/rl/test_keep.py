"""A kept policy: the same actions, no training state, nothing of the machine that trained it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from saved import save_run

from pace.rl.keep import main
from pace.rl.loading import load_policy


def test_the_kept_policy_acts_like_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = save_run(tmp_path / "run")
    (run / "metrics.csv").write_text("update,samples\n3,99\n")
    evaluation = tmp_path / "evaluation"
    evaluation.mkdir()
    (evaluation / "evaluation.json").write_text("{}")
    kept = tmp_path / "pretrained" / "mine"
    assert main([str(run), str(kept), "--evaluation", str(evaluation)]) == 0
    assert "metrics.csv" in capsys.readouterr().out
    names = {file.name for file in kept.iterdir()}
    assert names == {"checkpoint.json", "weights.safetensors", "metrics.csv", "evaluation.json"}
    before, after = load_policy(run), load_policy(kept)
    observation = torch.randn(5, 450)
    torch.testing.assert_close(after(observation), before(observation), atol=1e-6, rtol=0)
    assert (after.config.engine.name, after.config.engine.threads, after.config.run_dir) == ("auto", 0, None)


@pytest.mark.parametrize("case", ["no run", "no evaluation"])
def test_wrong_folders_are_one_line(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "nothing" if case == "no run" else save_run(tmp_path / "run")
    extra = ["--evaluation", str(tmp_path)] if case == "no evaluation" else []
    assert main([str(run), str(tmp_path / "kept"), *extra]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "kept").exists()
