"""The training loop on a dummy task: it learns, repeats by seed, resumes exactly, and leaves a checkpoint behind."""

from __future__ import annotations

import json
import math
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from pace.config.base import ConfigError, parse, to_dict
from pace.config.schedules import SchedulePoint
from pace.config.training import TrainConfig, load_train_config
from pace.predictor.network import PredictorNetwork
from pace.rl.ppo import AsymmetricPPO
from pace.rl.rates import rates
from pace.rl.rollout import Rollout, RolloutError
from pace.rl.trainer import Trainer
from pace.runs.checkpoint import CheckpointError, load_checkpoint
from pace.runs.checkpoint_folders import list_checkpoints
from pace.runs.metrics import read_metrics
from pace.runs.optimiser import learning_rate
from pace.runs.run_folder import RunFolder
from tests.helpers.algo import IN_SAMPLES
from tests.helpers.dummy import DummyTask
from tests.helpers.training import assert_same, dummy_trainer

WORLDS = 64
UPDATE = WORLDS * 12


def make_config(updates: int = 2, **changes: object) -> TrainConfig:
    config = load_train_config(
        [
            f"num_worlds={WORLDS}",
            f"samples={updates * UPDATE}",
            "algo.steps=12",
            "algo.actor_hidden=[32,32]",
            "algo.critic_hidden=[32,32]",
            "algo.autocast=fp32",
            "predictor.batches_per_update=4",
            "tensorboard=false",
            "progress=false",
            *IN_SAMPLES,
        ]
    )
    for name, value in changes.items():
        setattr(config, name, value)
    return config


def make_trainer(path: Path, updates: int = 2, resume: bool = False, **changes: object) -> Trainer:
    config = make_config(updates, **changes)
    torch.manual_seed(config.seed)
    saved = load_checkpoint(path) if resume else None
    predictor = PredictorNetwork(config.predictor)
    first = int(saved.counters["updates"]) if saved else 0
    run = RunFolder(path, to_dict(config), config.tensorboard, first)
    trainer = Trainer(config, DummyTask(WORLDS, config.seed), predictor, run)
    if saved:
        trainer.resume(saved)
    return trainer


def learner(trainer: Trainer) -> AsymmetricPPO:
    assert isinstance(trainer.algorithm, AsymmetricPPO)
    return trainer.algorithm


def stored(trainer: Trainer) -> Rollout:
    rollout = learner(trainer).rollout
    assert rollout is not None
    return rollout


def all_weights(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {**trainer.agent.state_dict(), **{f"predictor.{k}": v for k, v in trainer.predictor.state_dict().items()}}


@pytest.mark.slow
def test_it_learns_the_dummy_task(tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, updates=60)
    before = {name: value.clone() for name, value in all_weights(trainer).items()}
    summary = trainer.train()
    assert summary is not None
    metrics = read_metrics(tmp_path / "metrics.csv")
    assert len(metrics["update"]) == 60
    assert sum(metrics["mean_reward"][-5:]) / 5 > 0.5 * metrics["mean_reward"][0]  # rewards are negative distances
    assert metrics["predictor_rmse_cm"][-1] < 0.7 * metrics["predictor_rmse_cm"][0]
    assert metrics["samples"][-1] == 60 * UPDATE
    assert metrics["reward/distance"] == metrics["mean_reward"]
    assert all(not torch.equal(before[name], value) for name, value in all_weights(trainer).items())
    assert summary.reason.startswith("samples=")
    assert summary.curve is not None
    assert summary.curve.stat().st_size > 10_000


def test_a_seed_reproduces_and_another_does_not(tmp_path: Path) -> None:
    weights = []
    for index, seed in enumerate((1, 1, 2)):
        trainer = make_trainer(tmp_path / str(index), seed=seed)
        trainer.train()
        weights.append(all_weights(trainer))
    first, same, other = weights
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not torch.equal(first["actor.mlp.layers.0.weight"], other["actor.mlp.layers.0.weight"])


def test_two_and_two_updates_equal_four(tmp_path: Path) -> None:
    whole = make_trainer(tmp_path / "whole", updates=4)
    whole.train()
    make_trainer(tmp_path / "parts", updates=2).train()
    resumed = make_trainer(tmp_path / "parts", updates=4, resume=True)
    assert resumed.updates == 2
    resumed.train()
    expected, found = all_weights(whole), all_weights(resumed)
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    rows = [read_metrics(tmp_path / run / "metrics.csv") for run in ("whole", "parts")]
    assert rows[0]["update"] == rows[1]["update"] == [1, 2, 3, 4]
    for column in ("mean_reward", "kl", "lr", "predictor_rmse_cm", "policy_std"):
        assert rows[0][column] == rows[1][column]


def test_a_spread_that_may_rise_resumes_as_it_was(tmp_path: Path) -> None:
    def trainer() -> Trainer:
        config = make_config()
        config.algo.std = [SchedulePoint(0.0, 0.5), SchedulePoint(1.0, 1.0)]
        return Trainer(config, DummyTask(WORLDS), PredictorNetwork(config.predictor), None)

    first, second = trainer(), trainer()
    with torch.no_grad():
        learner(first).agent.actor.spread.state_independent_scale.fill_(math.log(0.8))
    second.resume(first.checkpoint())
    assert learner(second).agent.actor.std[0].item() == pytest.approx(0.8)
    second.start_from(first.checkpoint())  # a new run begins with its own
    assert learner(second).agent.actor.std[0].item() == pytest.approx(0.5)


@pytest.mark.slow
def test_later_updates_can_be_longer_and_resume_exactly(tmp_path: Path) -> None:
    def later(path: Path, samples: int, resume: bool = False) -> Trainer:
        algo = replace(make_config().algo, later_steps=[SchedulePoint(2.0 * UPDATE, 18.0)])
        trainer = make_trainer(path, resume=resume, algo=algo, samples=float(samples))
        trainer.train()
        return trainer

    longer = WORLDS * 18
    whole = later(tmp_path / "whole", 2 * UPDATE + 2 * longer)
    assert read_metrics(tmp_path / "whole" / "metrics.csv")["samples"] == [
        UPDATE, 2 * UPDATE, 2 * UPDATE + longer, 2 * UPDATE + 2 * longer
    ]  # fmt: skip
    assert stored(whole).steps == whole.regression.steps == 18
    later(tmp_path / "parts", 2 * UPDATE + longer)
    resumed = later(tmp_path / "parts", 2 * UPDATE + 2 * longer, resume=True)
    expected, found = all_weights(whole), all_weights(resumed)
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    with pytest.raises(ConfigError, match=r"later_steps: 1\.5 is no number of steps"):
        replace(make_config().algo, later_steps=[SchedulePoint(0.0, 1.5)])


@pytest.mark.slow
def test_a_run_changes_to_float32_when_its_spread_is_small_and_resumes_exactly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    std = [SchedulePoint(0.0, 0.5), SchedulePoint(2.0 * UPDATE, 0.1)]

    def narrowing(path: Path, updates: int, resume: bool = False) -> Trainer:
        algo = replace(make_config().algo, autocast="auto", fp32_below=0.2, std=std)
        trainer = make_trainer(path, updates, resume, algo=algo)
        assert learner(trainer).agent.observation_dtype == (torch.float32 if resume else torch.bfloat16)
        trainer.train()
        return trainer

    whole = narrowing(tmp_path / "whole", 5)
    assert stored(whole).policy.dtype == torch.float32
    narrowing(tmp_path / "parts", 4)
    resumed = narrowing(tmp_path / "parts", 5, resume=True)
    expected, found = all_weights(whole), all_weights(resumed)
    assert all(torch.equal(expected[name], found[name]) for name in expected)


def test_a_checkpoint_of_before_there_were_other_algorithms_is_resumed(tmp_path: Path) -> None:
    first, second = make_trainer(tmp_path / "first"), make_trainer(tmp_path / "second")
    first.train()
    old = first.checkpoint()
    assert old.training is not None
    old.training["ppo"] = old.training.pop("algorithm")
    second.resume(old)
    assert learner(second).ppo.actor_optimiser.state


def test_rows_after_the_checkpoint_are_replaced_by_a_resume(tmp_path: Path) -> None:
    make_trainer(tmp_path, updates=2).train()
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("3,99999\n")  # an update that the interrupted run logged and did not save
    make_trainer(tmp_path, updates=3, resume=True).train()
    assert read_metrics(tmp_path / "metrics.csv")["samples"] == [UPDATE, 2 * UPDATE, 3 * UPDATE]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_run_with_a_checkpoint(
    tmp_path: Path, number: signal.Signals, request: pytest.FixtureRequest
) -> None:
    ignored = signal.signal(number, signal.default_int_handler)  # under nohup a lost terminal is, and stays so
    request.addfinalizer(lambda: signal.signal(number, ignored))
    trainer = make_trainer(tmp_path, updates=1000)
    advance = trainer.env.advance
    calls = 0

    def interrupted(action: torch.Tensor) -> None:
        nonlocal calls
        calls += 1
        if calls == 30:  # in the third update
            os.kill(os.getpid(), number)
        advance(action)

    trainer.env.advance = interrupted  # type: ignore[method-assign]
    before = signal.getsignal(number)
    summary = trainer.train()
    assert summary is not None
    assert signal.getsignal(number) is before
    assert summary.reason == f"stopped by {number.name}"
    assert summary.updates == 3
    assert load_checkpoint(tmp_path).counters["updates"] == 3
    assert (tmp_path / "learning_curve.png").exists()


def test_a_nan_keeps_the_last_good_checkpoint(tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, updates=10, checkpoint_minutes=0.0)
    trainer.config.algo.skips = 0
    trainer.env.poison_step = 30  # type: ignore[attr-defined]
    with pytest.raises(RolloutError, match="column 1 of world 3 "):
        trainer.train()
    assert load_checkpoint(tmp_path / "last_good").counters["updates"] == 2
    saved = load_checkpoint(tmp_path)
    assert saved.counters["updates"] == 2
    for name, tensor in load_checkpoint(tmp_path / "last_good").weights["agent"].items():
        assert torch.equal(tensor, saved.weights["agent"][name])
    assert all(torch.isfinite(tensor).all() for tensor in saved.weights["agent"].values())


def test_minutes_end_a_run(tmp_path: Path) -> None:
    summary = make_trainer(tmp_path, updates=10_000, minutes=0.5 / 60).train()
    assert summary is not None
    assert summary.reason.startswith("minutes=")
    assert summary.seconds < 10


def test_old_checkpoints_are_dropped(tmp_path: Path) -> None:
    make_trainer(tmp_path, updates=7, checkpoint_minutes=0.0).train()
    assert [int(folder.name[7:]) for folder in list_checkpoints(tmp_path)] == [4, 5, 6, 7]


def test_run_folder_holds_what_rebuilds_the_run(tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, tensorboard=True)
    trainer.train()
    config = parse(OmegaConf.load(tmp_path / "config.yaml"), TrainConfig)  # type: ignore[arg-type]
    assert config == trainer.config
    assert parse(load_checkpoint(tmp_path).config, TrainConfig) == trainer.config
    found = json.loads((tmp_path / "versions.json").read_text())["packages"]["torch"]
    assert found.partition("+")[0] == torch.__version__.partition("+")[0]  # wheels for a GPU name it in one of the two
    assert list((tmp_path / "events").glob("events.out.tfevents*"))


def test_init_from_takes_the_weights_and_nothing_else(tmp_path: Path) -> None:
    old = make_trainer(tmp_path / "old", updates=3)
    old.train()
    new = make_trainer(tmp_path / "new")
    new.load_weights(load_checkpoint(tmp_path / "old", weights_only=True))
    assert new.samples == 0
    expected, found = all_weights(old), all_weights(new)
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert not learner(new).ppo.actor_optimiser.state


def test_weights_of_another_size_are_refused(tmp_path: Path) -> None:
    make_trainer(tmp_path / "old").train()
    config = make_config()
    config.algo.actor_hidden = [48, 32]
    new = Trainer(config, DummyTask(WORLDS), PredictorNetwork(config.predictor), RunFolder(tmp_path / "new", {}, False))
    with pytest.raises(CheckpointError, match=r"actor\.mlp\.layers\.0\.weight has the shape \(32, 6\)"):
        new.load_weights(load_checkpoint(tmp_path / "old"))


def test_a_finished_run_has_nothing_left_to_do(tmp_path: Path) -> None:
    make_trainer(tmp_path).train()
    with pytest.raises(ConfigError, match="nothing left to do"):
        make_trainer(tmp_path, resume=True).train()


def test_rates_of_the_statistics() -> None:
    sums = {
        "serves": 8.0, "hits": 4.0, "successes": 2.0, "falls": 3.0, "episodes": 5.0, "steps": 600.0,
        "reward_sum": 60.0, "reward/hit": 30.0, "net": 1.0,
    }  # fmt: skip
    row = rates(sums, control_dt=0.02)
    assert (row["hit_rate"], row["success_rate"], row["net"]) == (0.5, 0.25, 0.125)
    assert row["fall_rate"] == pytest.approx(0.25)  # 3 falls in 600 x 0.02 s
    assert (row["mean_reward"], row["reward/hit"]) == pytest.approx((0.1, 0.05))


def test_a_run_folder_has_one_owner(tmp_path: Path) -> None:
    first = RunFolder(tmp_path, {}, False)
    first.log({"update": 1.0, "samples": 4.0})
    with pytest.raises(ConfigError, match="in use by another process: end that first, or give another out="):
        RunFolder(tmp_path, {}, False)
    first.log({"update": 2.0, "samples": 8.0})
    first.close()
    assert read_metrics(tmp_path / "metrics.csv")["update"] == [1.0, 2.0]  # the second has touched nothing
    RunFolder(tmp_path, {}, False, 2).close()


def test_a_run_that_starts_from_weights_begins_with_steps_that_their_std_allows(tmp_path: Path) -> None:
    """Adam's first steps are as large as the learning rate, and at a tenth of the std their KL a hundred times."""
    for std, rate in ((0.1, 1e-5), (0.5, 2.5e-4), (1.0, 1e-3)):
        old, new = (dummy_trainer(tmp_path / f"{part}_{std}", 3) for part in ("old", "new"))
        learner(old).agent.actor.bound_std(0.05, std)
        new.start_from(old.checkpoint())
        assert learning_rate(learner(new).ppo.actor_optimiser).item() == pytest.approx(rate)
        assert learning_rate(learner(new).ppo.critic_optimiser).item() == pytest.approx(1e-3)
        said = f"the actor's learning rate at {rate:.2g} first, as a std of {std:.2g} allows"
        assert (said in learner(new).describe()) == (std < 1.0)


class Watching:
    """A judge that gives numbers of its own."""

    def __init__(self) -> None:
        self.seen: list[Path] = []

    def quick(self, checkpoint: Path, minutes: float) -> dict[str, float]:
        """Random numbers of its own would be another judge's business: this one takes none."""
        assert minutes >= 0.0
        assert (checkpoint / "weights.safetensors").exists()
        self.seen.append(checkpoint)
        return {"eval_hit": 0.25 * len(self.seen), "eval_success": 0.5}

    def last(self, run: Path, minutes: float) -> None:
        """Whoever made the trainer asks for it."""
        raise AssertionError(f"{run} after {minutes}")


def test_a_judgement_follows_each_checkpoint_and_is_in_the_next_row(tmp_path: Path) -> None:
    judged = dummy_trainer(tmp_path / "judged", 4)
    judged.judge = judge = Watching()
    judged.train()
    dummy_trainer(tmp_path / "alone", 4).train()
    assert len(judge.seen) == 3  # the last checkpoint is left to the judgement at the end
    found = read_metrics(tmp_path / "judged" / "metrics.csv")
    assert found["eval_hit"][1:] == [0.25, 0.5, 0.75]
    assert math.isnan(found["eval_hit"][0])
    assert all(map(math.isnan, read_metrics(tmp_path / "alone" / "metrics.csv")["eval_success"]))
    one, other = load_checkpoint(tmp_path / "judged"), load_checkpoint(tmp_path / "alone")
    assert_same(one.weights, other.weights)
    assert_same(one.training, other.training)
