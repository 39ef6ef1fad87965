"""The study of the predictor: its flights are the task's, and its bound is what the task's noise leaves."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from pace.config.training import TrainConfig
from pace.studies import predictor
from pace.studies.__main__ import main
from pace.studies.flights import FlightModel, ServePrior, record
from pace.studies.posterior import Question, answer

FRAMES = 42


def config(case: str, serves: int, noise: float | None = None) -> TrainConfig:
    config = predictor.case_config(case, serves)
    if noise is not None:
        config.sensing.ball_position = noise
    return config


@pytest.mark.parametrize("case", ["rubber", "all (wide)", "paper, clean", "rubber, machine"])
def test_the_model_senses_what_the_task_senses(case: str) -> None:
    task = config(case, 32, noise=0.0)
    recording = record(task, FRAMES)
    model = FlightModel(task, 32)
    off = (model.sensed(recording.cube, FRAMES) - recording.sensed).norm(dim=2)
    assert recording.valid[:, :30].float().mean().item() > 0.9
    assert off[recording.valid].max().item() < 2e-5
    torch.testing.assert_close(model.apex(recording.cube), recording.apex, atol=1e-5, rtol=0)


def test_noise_stays_within_what_the_bound_takes_for_possible() -> None:
    task = config("rubber", 64)
    recording = record(task, FRAMES)
    off = (FlightModel(task, 64).sensed(recording.cube, FRAMES) - recording.sensed).abs()[recording.valid]
    assert 0.0069 < off.max().item() < 0.00702


def test_the_prior_of_a_machine_is_that_of_the_balls_it_serves() -> None:
    task = config("rubber, machine", 2000)
    model, recording = FlightModel(task, 2000), record(task, 1)
    assert bool(model.served(recording.cube).all())
    anywhere = torch.rand(recording.cube.shape, generator=torch.Generator().manual_seed(1))
    assert model.served(anywhere).float().mean().item() == pytest.approx(0.4, abs=0.04)
    used = torch.zeros(16, 1, dtype=torch.bool)  # nothing was seen
    known = Question(recording.cube[:16], recording.sensed[:16], used)
    few = config("rubber, machine", 16)
    spread = recording.apex.var(0).sum().sqrt().item()
    assert answer(few, known, chains=4, steps=200).std.mean().item() == pytest.approx(spread, rel=0.15)


def test_the_cube_holds_the_whole_prior() -> None:
    prior = ServePrior(config("rubber", 1))
    assert len(prior.names) == 9
    corners = prior.values(torch.tensor([[0.0] * 9, [1.0] * 9]))
    torch.testing.assert_close(corners["velocity_x"], torch.tensor([-6.5, -5.2]))
    torch.testing.assert_close(corners["delay"], torch.tensor([0.2, 0.5]))
    torch.testing.assert_close(corners["table_restitution"], torch.tensor([0.95, 0.99]))
    torch.testing.assert_close(corners["mass"], torch.tensor([0.97, 1.03]) * 0.0027)
    assert corners["position_x"].tolist() == pytest.approx([1.35, 1.35])
    points = torch.rand(5, 9, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(prior.cube(prior.values(points)), points, atol=1e-4, rtol=0)


def test_a_clean_flight_of_a_known_ball_leaves_nothing_unknown() -> None:
    task = config("rubber, ball known, clean", 16)
    recording = record(task, 12)
    used = torch.arange(12).repeat(16, 1) > 6
    found = answer(task, Question(recording.cube, recording.sensed, used), chains=2, steps=60)
    assert (found.mean - recording.apex).norm(dim=1).max().item() < 0.005
    assert found.std.max().item() < 0.005


def test_before_anything_is_seen_the_bound_is_the_spread_of_the_serves() -> None:
    task = config("rubber, ball known", 1024)
    recording = record(task, 1)
    everyone = recording.valid[:, 0]
    prior = recording.apex[everyone].var(0).sum().sqrt().item()
    some = Question(recording.cube[:48], recording.sensed[:48], torch.zeros(48, 1, dtype=torch.bool))
    found = answer(task, some, chains=4, steps=200)
    assert found.std.mean().item() == pytest.approx(prior, rel=0.1)
    truth = recording.apex[:48]
    assert 100 * (found.mean - truth).square().sum(1).mean().sqrt().item() == pytest.approx(100 * prior, rel=0.2)


def test_the_error_of_the_posterior_mean_is_the_spread_of_the_posterior() -> None:
    """Which holds only where the chains have forgotten the truth that they began at."""
    task = config("rubber, ball known", 80)
    recording = record(task, 28)
    used = torch.arange(28).repeat(80, 1) >= 23
    found = answer(task, Question(recording.cube, recording.sensed, used), chains=2, steps=300)
    error = (found.mean - recording.apex).square().sum(1).mean().sqrt().item()
    assert error == pytest.approx(found.std.square().mean().sqrt().item(), rel=0.2)
    assert 0.005 < error < 0.02


def test_the_command_prints_a_table_and_writes_a_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predictor, "STEPS", 6)
    given = ["predictor", "serves=6", "cases=[rubber]", "predictors=[pretrained/pace]", f"out={tmp_path}"]
    monkeypatch.setattr(sys, "argv", ["studies", *given])
    assert main() == 0
    printed = capsys.readouterr().out
    assert printed.count("\n| rubber | ") == 3
    assert "| rubber | pace | " in printed
    assert (tmp_path / "predictor.png").stat().st_size > 10_000


def test_a_predictor_that_is_not_there_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = ["predictor", "cases=[rubber]", f"predictors=['{tmp_path / 'gone'}']", f"out={tmp_path}"]
    monkeypatch.setattr(sys, "argv", ["studies", *given])
    assert main() == 1
    assert "gone does not exist" in capsys.readouterr().err
