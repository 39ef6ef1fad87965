"""``python -m pace.predictor``: practice serves are those of the task, and the predictor learns them."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import pytest
import torch

from pace.config.base import compose, parse
from pace.config.training import TrainConfig
from pace.predictor.__main__ import main
from pace.predictor.regression import PredictorTrainer
from pace.rl.practice import ServePractice
from pace.rl.predictor_run import PredictorRun
from pace.runs.checkpoint import load_checkpoint
from pace.runs.checkpoint_folders import list_checkpoints


def practice_config(*overrides: str) -> TrainConfig:
    return parse(compose("predictor_train", ["num_worlds=64", *overrides]), TrainConfig)


def test_practice_targets_are_where_the_ball_then_flies() -> None:
    practice = ServePractice(practice_config("sensing=clean", "randomization=none"), torch.device("cpu"))
    highest = torch.full((64,), -1.0)
    apex = practice.predictor_target[:, :3].clone()
    bounced = torch.zeros(64, dtype=torch.bool)
    for _ in range(40):  # 0.8 s: past the apex of every serve, before any serve is over
        practice.advance()
        bounced |= practice.ball.events.own_bounce > 0
        highest = torch.where(bounced, torch.maximum(highest, practice.ball.position[:, 2]), highest)
    assert bounced.all()
    assert (highest - apex[:, 2]).abs().max().item() < 2e-3  # 20 ms between looks at a parabola's top: 0.5 mm
    assert torch.equal(practice.predictor_target[:, :3], apex)


def test_practice_senses_the_true_ball_when_sensing_is_clean() -> None:
    practice = ServePractice(practice_config("sensing=clean"), torch.device("cpu"))
    for _ in range(8):
        practice.advance()
    newest = practice.predictor_input[:, -3:]
    torch.testing.assert_close(newest, practice.ball.position)
    assert (newest - practice.predictor_input[:, -6:-3]).norm(dim=1).min().item() > 0.05


def test_the_learning_rate_falls_and_a_stop_keeps_what_was_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates: list[float] = []
    fit = PredictorTrainer.update

    def update(trainer: PredictorTrainer) -> dict[str, float]:
        rates.append(float(trainer.optimiser.param_groups[0]["lr"]))
        if len(rates) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return fit(trainer)

    monkeypatch.setattr(PredictorTrainer, "update", update)
    overrides = ["num_worlds=64", "samples=3072", "minutes=0", "progress=false", "predictor.batches_per_update=2"]
    monkeypatch.setattr(sys, "argv", ["train", f"out={tmp_path}", *overrides])
    assert main() == 0
    assert load_checkpoint(tmp_path).counters["updates"] == 3
    assert rates == pytest.approx([0.004, 0.00342, 0.00202], rel=0.01)


def test_what_was_learned_is_saved_in_between_and_before_it_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[list[str]] = []
    fit = PredictorTrainer.update

    def update(trainer: PredictorTrainer) -> dict[str, float]:
        saved.append([folder.name for folder in list_checkpoints(tmp_path)])
        return fit(trainer)

    def terminated(_: PredictorRun) -> dict[str, float]:
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("SIGTERM has ended the command")

    monkeypatch.setattr(PredictorTrainer, "update", update)
    monkeypatch.setattr(PredictorRun, "measure", terminated)
    overrides = ["num_worlds=64", "minutes=0", "checkpoint_minutes=0", "progress=false", "algo.steps=4"]
    overrides += ["samples=768", "predictor.batches_per_update=2"]
    monkeypatch.setattr(sys, "argv", ["train", f"out={tmp_path}", *overrides])
    assert main() == 75
    assert saved == [[], ["update_00000001"], ["update_00000001", "update_00000002"]]
    assert load_checkpoint(tmp_path).counters["updates"] == 3


@pytest.mark.slow
def test_command_trains_and_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    overrides = ["num_worlds=256", "samples=120e3", "minutes=0", "progress=false", "predictor.batches_per_update=40"]
    monkeypatch.setattr(sys, "argv", ["train", f"out={tmp_path}", *overrides])
    assert main() == 0
    result = json.loads((tmp_path / "predictor.json").read_text())
    assert result["errors"]["predictor_rmse_cm"] < 16.0
    assert result["errors"]["predictor_rmse_cm/0.1_0.2s"] < 12.0
    saved = load_checkpoint(tmp_path)
    assert saved.counters["samples"] >= 120e3
    assert saved.weights["predictor"]["layers.0.weight"].shape == (64, 15)
