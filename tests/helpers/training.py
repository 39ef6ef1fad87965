"""A training run on the dummy task, in a folder, and what its files hold."""

from __future__ import annotations

from pathlib import Path

import torch

from pace.config.base import to_dict
from pace.config.training import TrainConfig, load_train_config
from pace.predictor.network import PredictorNetwork
from pace.rl.trainer import Trainer
from pace.runs.checkpoint import load_checkpoint
from pace.runs.metrics_file import read_rows
from pace.runs.run_folder import RunFolder
from tests.helpers.algo import IN_SAMPLES
from tests.helpers.dummy import DummyTask

WORLDS, STEPS = 16, 4
UPDATE = WORLDS * STEPS
TIMES = ("wall_s", "samples_per_s")


def dummy_config(updates: int, **changes: object) -> TrainConfig:
    """A small learner that saves after every update."""
    config = load_train_config(
        [
            f"num_worlds={WORLDS}", f"samples={updates * UPDATE}", "minutes=0", f"algo.steps={STEPS}",
            "algo.actor_hidden=[16]", "algo.critic_hidden=[16]", "algo.autocast=fp32",
            "predictor.batches_per_update=1", "tensorboard=false", "progress=false", "checkpoint_minutes=0",
            *IN_SAMPLES,
        ]
    )  # fmt: skip
    for name, value in changes.items():
        setattr(config, name, value)
    return config


def dummy_trainer(path: Path, updates: int, resume: bool = False, **changes: object) -> Trainer:
    """A trainer in the folder ``path``, new or resumed."""
    config = dummy_config(updates, **changes)
    torch.manual_seed(config.seed)
    saved = load_checkpoint(path) if resume else None
    predictor = PredictorNetwork(config.predictor)
    run = RunFolder(path, to_dict(config), config.tensorboard, int(saved.counters["updates"]) if saved else 0)
    trainer = Trainer(config, DummyTask(WORLDS, config.seed), predictor, run)
    if saved:
        trainer.resume(saved)
    return trainer


def rows_of(run: Path) -> list[dict[str, str]]:
    """Rows of a run's metrics without the times, which no two runs share."""
    _, rows = read_rows((run / "metrics.csv").read_text())
    return [{name: cell for name, cell in row.items() if name not in TIMES} for row in rows]


def assert_same_run(first: Path, second: Path) -> None:
    """Two runs have done the same updates, bit for bit, and have the same weights and training state."""
    assert rows_of(first) == rows_of(second)
    one, other = load_checkpoint(first), load_checkpoint(second)
    assert one.counters["updates"] == other.counters["updates"]
    assert_same(one.weights, other.weights)
    assert_same(one.training, other.training)


def assert_same(one: object, other: object, place: str = "") -> None:
    """Nested dictionaries and lists of tensors are equal."""
    if isinstance(one, dict) and isinstance(other, dict):
        assert one.keys() == other.keys(), place
        for key in one:
            assert_same(one[key], other[key], f"{place}.{key}")
    elif isinstance(one, list) and isinstance(other, list):
        assert len(one) == len(other), place
        for index, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{place}[{index}]")
    elif isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        torch.testing.assert_close(one, other, rtol=0.0, atol=0.0, equal_nan=True, msg=place)
    else:
        assert one == other, place
