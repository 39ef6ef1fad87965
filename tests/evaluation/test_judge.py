"""Judgements of a training run: they play without exploration and change nothing of the run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from pace.config.base import ConfigError
from pace.config.commands import PaperRow
from pace.config.judge import JudgeConfig
from pace.config.training import load_train_config
from pace.evaluation import judge as judging
from pace.evaluation.judge import RunJudge, closing_table
from pace.evaluation.serves import EvaluationError, evaluate_row
from pace.evaluation.task import policy_on
from pace.rl.policies import load_policy

POLICY = Path("pretrained/pace")
QUICK = JudgeConfig(serves=8, worlds=4, last_serves=8, last_worlds=4, warmup_serves=0, physics_dt=0.01, after=1.0)


def test_a_quick_judgement_is_a_row_of_an_evaluation_and_takes_no_random_numbers() -> None:
    torch.manual_seed(3)
    before = torch.get_rng_state()
    found = RunJudge(QUICK).quick(POLICY, minutes=1.0)
    assert torch.equal(torch.get_rng_state(), before)
    policy = policy_on("table", load_policy(POLICY))
    row = evaluate_row(policy, "mixed", 8, 4, "cpu", 1, ["engine.physics_dt=0.01"], 0).summary
    assert found == {"eval_hit": row["hit"], "eval_success": row["success"]}
    assert found["eval_hit"] > 0.5  # it can play


def test_short_runs_and_none_asked_for_are_not_judged(capsys: pytest.CaptureFixture[str]) -> None:
    assert RunJudge(QUICK).quick(POLICY, minutes=0.9) == {}
    assert RunJudge(JudgeConfig(serves=0, after=0.0)).quick(POLICY, minutes=5.0) == {}
    RunJudge(QUICK).last(POLICY, minutes=0.9)
    RunJudge(JudgeConfig(last_serves=0, after=0.0)).last(POLICY, minutes=5.0)
    assert capsys.readouterr().out == ""


def test_serves_that_cannot_be_played_are_a_warning(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: object) -> None:
        raise EvaluationError("only 3 of 8 serves were playable")

    monkeypatch.setattr(judging, "evaluate_row", fails)
    assert RunJudge(QUICK).quick(POLICY, minutes=1.0) == {}
    assert "warning: pretrained/pace cannot be judged: only 3 of 8" in capsys.readouterr().err


def test_the_last_judgement_has_a_table_beside_the_papers_and_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(judging, "load_policy", lambda _: load_policy(POLICY))
    RunJudge(QUICK).last(tmp_path, minutes=1.0)
    printed = capsys.readouterr().out
    assert "task=table: robot=t1" in printed
    assert "the paper" in printed
    assert "97.6" in printed
    written = json.loads((tmp_path / "evaluation" / "evaluation.json").read_text())
    assert written["rows"][0]["serves"] == 8
    assert f"{100 * written['rows'][0]['hit']:.1f}" in printed
    assert (tmp_path / "evaluation" / "strike_map.png").stat().st_size > 5_000


def test_the_closing_table() -> None:
    row = {"serve": "mixed", "serves": 1500, "hit": 0.993, "hit_low": 0.987, "hit_high": 0.996}
    row |= {"success": 0.93, "success_low": 0.916, "success_high": 0.942, "falls_per_1000": 1.3}
    lines = [line.split("  ") for line in closing_table(row, {"mixed": PaperRow(100, 0.976, 0.941)}).splitlines()]
    cells = [[cell.strip() for cell in line if cell.strip()] for line in lines]
    assert cells[0] == ["1,500 mixed serves", "hit %", "95 %", "success %", "95 %", "falls/1,000"]
    assert cells[2] == ["this run", "99.3", "98.7 to 99.6", "93.0", "91.6 to 94.2", "1.3"]
    assert cells[3] == ["the paper", "97.6", "94.1"]


def test_its_numbers_are_checked_and_may_change_in_a_resumed_run() -> None:
    assert load_train_config(["judge.serves=0"]).judge == JudgeConfig(serves=0)
    assert load_train_config().judge == JudgeConfig()  # a run that was saved without them is judged as a new one
    with pytest.raises(ConfigError, match=r"judge\.worlds"):
        load_train_config(["judge.worlds=0"])
    with pytest.raises(ConfigError, match=r"judge\.physics_dt"):
        load_train_config(["judge.physics_dt=-1"])
