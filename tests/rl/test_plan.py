"""The plan of a run: what follows from its limits, what is measured, and that it stays."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from pace.config.training import TrainConfig, load_train_config
from pace.distributed import ProcessGroup
from pace.predictor.network import PredictorNetwork
from pace.rl import trainer as module
from pace.rl.plan import Plan
from pace.rl.trainer import Trainer
from pace.runs.checkpoint import load_checkpoint
from pace.runs.run_folder import RunFolder
from tests.helpers.dummy import DummyTask

WORLDS = 16
UPDATE = WORLDS * 4
SMALL = (
    f"num_worlds={WORLDS}", "algo.steps=4", "algo.actor_hidden=[8]", "algo.critic_hidden=[8]", "progress=false",
    "predictor.batches_per_update=1", "tensorboard=false", "plan.warm_up=2", "plan.updates=3", "plan.seconds=1.0",
)  # fmt: skip


def config_of(*overrides: str) -> TrainConfig:
    return load_train_config([*SMALL, *overrides])


def test_what_follows_from_the_limits() -> None:
    given = [("samples=5e6",), ("samples=5e6", "minutes=0"), ("samples=inf", "minutes=0"), ("minutes=3",)]
    known = [Plan(config_of(*limits)).samples for limits in (*given, ("minutes=3", "samples=9e6"))]
    assert known == [5e6, 5e6, 84e6, None, None]
    assert Plan(config_of("minutes=3")).open
    plan = Plan(config_of("experiment=paper", "minutes=3"))  # nothing in shares
    assert (plan.samples, plan.open) == (None, False)


def test_speed_is_measured_after_the_warm_up_over_enough_updates_and_time() -> None:
    plan = Plan(config_of("minutes=30", "plan.seconds=4.0"))
    slow_start = [(1000.0, 50.0), (2000.0, 60.0)]  # compiled kernels, captured graphs
    steady = [(2000.0 + 10_000.0 * n, 60.0 + n) for n in range(1, 5)]  # the third has updates enough, no time enough
    found = [plan.measure(*at) for at in (*slow_start, *steady)]
    assert found[:-1] == [None] * 5
    assert found[-1] is not None
    planned, said = found[-1]
    assert planned == pytest.approx(42_000 + 10_000 * (30 * 60 - 64))  # what is done, and the rest at this speed
    assert said == "planned: 17.4 M control steps (10,000/s for 30 min)"


def test_samples_are_the_plan_if_time_is_enough_for_them() -> None:
    plan = Plan(config_of("minutes=30", "samples=1e5"))
    found = [plan.measure(1000.0 * n, float(n)) for n in range(1, 6)]
    assert found[-1] is not None
    assert found[-1][0] == 1e5


class Clock:
    """A second passes with every look at it."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        self.now += 1.0
        return self.now


def trainer_of(config: TrainConfig, run: RunFolder | None = None, group: ProcessGroup | None = None) -> Trainer:
    torch.manual_seed(3)
    return Trainer(config, DummyTask(WORLDS), PredictorNetwork(config.predictor), run, group)


def test_a_run_says_and_saves_its_plan_and_a_resumed_one_keeps_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "time", Clock())
    config = config_of(f"samples={12 * UPDATE}", "minutes=1")
    trainer = trainer_of(config, RunFolder(tmp_path, {}, False))
    before = trainer.plan.position(100.0)
    trainer.train()
    assert before.share == 0.0
    assert capsys.readouterr().out.count("planned: 768 control steps (") == 1
    saved = load_checkpoint(tmp_path)
    assert saved.counters["planned"] == 12 * UPDATE
    assert trainer.agent.actor.std.max().item() <= 0.13  # type: ignore[union-attr]
    for limits in (("samples=inf", "minutes=5"), ("samples=1e9",), ("samples=inf", "minutes=0")):
        resumed = trainer_of(config_of(*limits))
        resumed.resume(saved)
        assert (resumed.plan.samples, resumed.plan.open) == (12 * UPDATE, False)
        assert resumed.plan.position(6.0 * UPDATE).share == 0.5
    del saved.counters["planned"]  # saved before it was known
    resumed = trainer_of(config_of("minutes=5"))
    resumed.resume(saved)
    assert resumed.plan.open


def test_without_minutes_nothing_is_measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(Plan, "measure", lambda *_: pytest.fail("measured"))
    trainer_of(config_of(f"samples={2 * UPDATE}"), RunFolder(tmp_path, {}, False)).train()
    assert load_checkpoint(tmp_path).counters["planned"] == 2 * UPDATE


class Told(ProcessGroup):
    """The second of two processes; what rank 0 broadcasts is given."""

    def __init__(self, values: list[Any]) -> None:
        super().__init__(1, 2)
        self.values = values

    def broadcast_object(self, value: Any) -> Any:
        del value
        return self.values.pop(0)

    def broadcast_(self, tensors: Any) -> None: ...


def test_the_plan_is_that_of_rank_0(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Plan, "measure", lambda *_: pytest.fail("measured by another rank"))
    trainer = trainer_of(config_of("minutes=5"), group=Told([(None, ""), (1e6, "planned: ...")]))
    progress: Any = None  # of rank 0
    trainer._measure(1.0, progress)
    assert trainer.plan.open
    trainer._measure(2.0, progress)
    assert trainer.plan.samples == 1e6
    trainer._measure(3.0, progress)  # nothing more is exchanged
    assert math.isclose(trainer.plan.position(5e5).share, 0.5)
