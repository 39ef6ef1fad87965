"""The online regression: it learns a flight, measures before it fits, freezes, and resumes."""

from __future__ import annotations

import copy
import math
from types import SimpleNamespace

import pytest
import torch

from pace.config.task import PredictorConfig
from pace.predictor.network import PredictorNetwork
from pace.predictor.regression import BIN_NAMES, PredictorTrainer
from tests.helpers.predictor import predictor_config, serves

STEPS, WORLDS = 4, 256


def make(**changes: object) -> PredictorTrainer:
    config: PredictorConfig = predictor_config(outputs=["apex"], batches_per_update=40, **changes)
    torch.manual_seed(1)
    return PredictorTrainer(PredictorNetwork(config), config, STEPS, WORLDS)


def play(trainer: PredictorTrainer, seed: int) -> None:
    """Record one rollout of noisy serves, a quarter of them without a target."""
    generator = torch.Generator().manual_seed(seed)
    for t in range(STEPS):
        positions, target = serves(WORLDS, seed=1000 * seed + t)
        valid = torch.rand(WORLDS, generator=generator) > 0.25
        noise = 0.002 * torch.randn(positions.shape, generator=generator)
        source = SimpleNamespace(
            predictor_input=positions + noise,
            predictor_target=torch.where(valid[:, None], target, math.nan),
            predictor_valid=valid,
            predictor_time_to_apex=0.5 * torch.rand(WORLDS, generator=generator),
        )
        trainer.record(t, source)  # type: ignore[arg-type]


def test_it_learns_a_flight_to_a_few_centimetres() -> None:
    trainer = make()
    errors = []
    for update in range(25):
        play(trainer, update)
        errors.append(trainer.update()["predictor_rmse_cm"])
    assert errors[0] > 25.0
    assert errors[-1] < 6.0


def test_rmse_is_of_valid_samples_before_the_fit_and_by_time() -> None:
    trainer = make()
    play(trainer, 3)
    with torch.no_grad():
        error = (trainer.network(trainer.inputs.flatten(0, 1)) - trainer.targets.flatten(0, 1)).square().sum(1)
    valid, time = trainer.valid.flatten(), trainer.time_to_apex.flatten()
    metrics = trainer.update()
    assert metrics["predictor_rmse_cm"] == pytest.approx(100 * error[valid].mean().sqrt().item(), rel=1e-4)
    second = valid & (time >= 0.1) & (time < 0.2)
    assert metrics[f"predictor_rmse_cm/{BIN_NAMES[2]}"] == pytest.approx(
        100 * error[second].mean().sqrt().item(), rel=1e-4
    )


def test_a_rollout_without_a_valid_sample_changes_nothing() -> None:
    trainer = make()
    play(trainer, 1)
    trainer.valid.zero_()
    before = copy.deepcopy(trainer.network.state_dict())
    assert math.isnan(trainer.update()["predictor_rmse_cm"])
    assert all(torch.equal(before[name], value) for name, value in trainer.network.state_dict().items())


def test_it_freezes_after_its_updates_and_still_measures() -> None:
    trainer = make(train_updates=2)
    for update in range(3):
        play(trainer, update)
        before = copy.deepcopy(trainer.network.state_dict())
        metrics = trainer.update()
        changed = any(not torch.equal(before[n], v) for n, v in trainer.network.state_dict().items())
        assert changed == (update < 2)
        assert math.isfinite(metrics["predictor_rmse_cm"])


def test_switched_off_it_neither_learns_nor_measures() -> None:
    trainer = make(enabled=False)
    play(trainer, 1)
    before = copy.deepcopy(trainer.network.state_dict())
    assert math.isnan(trainer.update()["predictor_rmse_cm"])
    assert all(torch.equal(before[name], value) for name, value in trainer.network.state_dict().items())


def test_state_restores_the_next_update() -> None:
    trainer = make()
    play(trainer, 1)
    trainer.update()
    twin = make()
    twin.network.load_state_dict(copy.deepcopy(trainer.network.state_dict()))
    twin.load_state_dict(copy.deepcopy(trainer.state_dict()))
    for each in (trainer, twin):
        torch.manual_seed(9)
        play(each, 2)
        each.update()
    for mine, theirs in zip(trainer.network.parameters(), twin.network.parameters(), strict=True):
        assert torch.equal(mine, theirs)
