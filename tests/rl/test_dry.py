"""``engine.graph=dry``: a training run replays what it recorded, bit for bit, and names what a graph could not hold."""

from __future__ import annotations

import itertools
import sys
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.objectives import ClipPPOLoss

from pace.arrays import graph
from pace.arrays.graph import Graphs
from pace.arrays.watch import DryRunError
from pace.config.schedules import START, SchedulePoint
from pace.config.training import TrainConfig, load_train_config
from pace.distributed import ProcessGroup
from pace.predictor.network import PredictorNetwork
from pace.predictor.regression import PredictorTrainer
from pace.rl import ppo
from pace.rl.adaptive_rate import KLAdaptiveRate
from pace.rl.loss import PPOLoss
from pace.rl.rollout import Rollout
from pace.rl.train import main
from pace.rl.trainer import Trainer
from pace.runs.checkpoint import Checkpoint, flatten_tensors, load_checkpoint
from pace.runs.metrics import read_metrics
from tests.helpers.algo import IN_SAMPLES
from tests.helpers.dummy import DummyTask
from tests.helpers.emulation import without_replay
from tests.helpers.groups import Echo, connected

WORLDS, STEPS = 16, 6
UPDATE = WORLDS * STEPS
SMALL = (
    f"num_worlds={WORLDS}", "samples=1e9", f"algo.steps={STEPS}", "algo.actor_hidden=[16]", "algo.critic_hidden=[16]",
    "predictor.batches_per_update=2", "tensorboard=false", "progress=false",
    "algo.kl_target=[{samples: 0, value: 1e-3}]",
)  # fmt: skip


def small_config(*overrides: str) -> TrainConfig:
    return load_train_config([*SMALL, *overrides])


def trainer_of(config: TrainConfig, graphs: Graphs = Graphs.DRY, group: ProcessGroup | None = None) -> Trainer:
    torch.manual_seed(3)
    env = DummyTask(WORLDS, graphs=graphs)
    return Trainer(config, env, PredictorNetwork(config.predictor), None, group)


def state_of(checkpoint: Checkpoint) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    flatten_tensors({"weights": checkpoint.weights, "training": checkpoint.training}, "", tensors)
    return tensors


def differing(first: dict[str, Tensor], second: dict[str, Tensor]) -> list[str]:
    """Names of the tensors that are not equal bit for bit (NaN equals NaN)."""
    assert first.keys() == second.keys()

    def bits(tensor: Tensor) -> Tensor:
        return torch.nan_to_num(tensor) if tensor.is_floating_point() else tensor

    return [
        name for name, value in first.items()
        if not torch.equal(bits(value), bits(second[name])) or not torch.equal(value.isnan(), second[name].isnan())
    ]  # fmt: skip


def test_updates_that_are_replayed_are_the_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Through a change of the number format and of the steps of an update."""
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    config = small_config("algo.autocast=auto", "algo.fp32_below=0.2", "algo.std_floor=0.01")
    config.algo.std = [SchedulePoint(4.0 * UPDATE, 0.5), SchedulePoint(5.0 * UPDATE, 0.1)]
    config.algo.later_steps = [SchedulePoint(11.0 * UPDATE, 8.0)]
    seen: dict[Graphs, list[Any]] = {Graphs.DRY: [], Graphs.NONE: []}
    ends = []
    for graphs, formats in seen.items():
        trainer = trainer_of(config, graphs)
        for _ in range(16):
            trainer.update()
            rollout = trainer.algorithm.storage()  # type: ignore[attr-defined]
            formats.append((rollout.policy.dtype, rollout.steps))
        ends.append(state_of(trainer.checkpoint()))
    assert seen[Graphs.DRY] == seen[Graphs.NONE]
    assert seen[Graphs.DRY] == [(torch.bfloat16, 6)] * 6 + [(torch.float32, 6)] * 5 + [(torch.float32, 8)] * 5
    assert differing(*ends) == []


def updated(trainer: Trainer, updates: int) -> Trainer:
    for _ in range(updates):
        trainer.update()
    return trainer


def resumed_after(updates: int, more: int, config: TrainConfig) -> list[str]:
    """What differs after so many updates and some ``more`` through a checkpoint, from all without one."""
    whole = state_of(updated(trainer_of(config), updates + more).checkpoint())
    saved = updated(trainer_of(config), updates).checkpoint()
    second = trainer_of(config)
    second.resume(saved)
    return differing(whole, state_of(updated(second, more).checkpoint()))


def test_four_and_four_updates_equal_eight() -> None:
    assert resumed_after(4, 4, small_config()) == []


def test_a_trainer_that_has_graphs_resumes_with_them() -> None:
    """Its tensors are loaded in place: the graphs go on with the loaded values."""
    trainer = updated(trainer_of(small_config()), 3)
    saved, ends = deepcopy(trainer.checkpoint()), []
    for _ in range(2):
        trainer.resume(deepcopy(saved))
        ends.append(state_of(updated(trainer, 4).checkpoint()))
    assert differing(*ends) == []


@pytest.mark.parametrize("spoilt", [0, 1, 2, 4])
def test_an_update_that_is_undone_leaves_the_graphs_as_they_are(spoilt: int) -> None:
    """It may be the one that warms up, that is recorded, or that is replayed; what is put back is what they read."""
    ends = []
    for graphs in (Graphs.DRY, Graphs.NONE):
        trainer = trainer_of(small_config(), graphs)
        for number in range(7):
            before = {name: value.clone() for name, value in trainer.agent.state_dict().items()}
            if number == spoilt:
                trainer.env.critic_observation[3, 1] = torch.nan
            row = trainer._safe_update()
            assert row["skipped"] == float(number == spoilt)
            assert (differing(before, trainer.agent.state_dict()) == []) == (number == spoilt)
        ends.append(state_of(trainer.checkpoint()))
    assert differing(*ends) == []
    assert all(bool(value.isfinite().all()) for name, value in ends[0].items() if name.startswith("weights"))


def test_a_run_of_which_nothing_can_be_captured_is_the_run_without_graphs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a GPU whose driver cannot: one line, and the same numbers."""

    class Uncapturable:
        def __init__(self, *_: Any) -> None:
            raise RuntimeError("operation not supported")

    monkeypatch.setattr(graph, "CudaGraph", Uncapturable)
    graph._SAID.clear()
    ends = [state_of(updated(trainer_of(small_config(), way), 5).checkpoint()) for way in (Graphs.TRY, Graphs.NONE)]
    assert differing(*ends) == []
    assert capsys.readouterr().err.count("warning: no CUDA graphs, so it is slower (") == 1


def test_a_rollout_in_the_place_of_another_has_its_own_graphs() -> None:
    """Python gives the id of an object that is gone to another one."""
    config, ends = small_config().algo, []
    for graphs in (Graphs.DRY, Graphs.NONE):
        trainer = trainer_of(small_config(), graphs)
        learner = ppo.PPO(trainer.agent, config)  # type: ignore[arg-type]
        for seed in range(3):
            torch.manual_seed(seed)
            rollout = Rollout(DummyTask(WORLDS, seed, graphs=graphs), trainer.agent, STEPS)  # type: ignore[arg-type]
            for name in ("policy", "critic", "action", "advantage", "value_target"):
                getattr(rollout, name).normal_()
            for _ in range(2):
                learner.update(rollout, START)
            del rollout
        ends.append({name: value.clone() for name, value in trainer.agent.state_dict().items()})
    assert differing(*ends) == []


def test_a_group_exchanges_one_buffer_between_two_graphs() -> None:
    """Several GPUs: forward and backward, the exchange, clip and Adam. Here with one process and its echo."""
    config = small_config("algo.observation_norm=false", "predictor.enabled=false")
    for name in ("std", "entropy"):  # which follow the samples, and a group of two has twice as many
        setattr(config.algo, name, [SchedulePoint(0.0, 0.5)])
    echo, ends = Echo(), []
    for group, graphs in ((echo, Graphs.DRY), (Echo(), Graphs.NONE), (ProcessGroup(), Graphs.DRY)):
        trainer = updated(trainer_of(config, graphs, group), 4)
        ends.append(state_of(trainer.checkpoint()))
    assert differing(ends[0], ends[1]) == []
    assert differing(ends[0], ends[2]) == []
    weights = sum(parameter.numel() for parameter in trainer.agent.parameters())
    messages = [size for size in echo.messages if size > 100]
    assert messages == [weights + 1] * (4 * config.algo.epochs * config.algo.minibatches)


def test_a_group_of_one_over_gloo_goes_the_way_of_two() -> None:
    """What tests/gpu does over NCCL: real messages between the graphs, with the numbers of the echo."""
    config, echo = small_config(), Echo()
    expected = state_of(updated(trainer_of(config, Graphs.DRY, echo), 5).checkpoint())
    with connected(torch.device("cpu")) as group:
        found = state_of(updated(trainer_of(config, Graphs.DRY, group), 5).checkpoint())
    assert differing(expected, found) == []
    assert group.messages == echo.messages
    assert len(group.messages) > 5 * config.algo.epochs * config.algo.minibatches


def test_the_fit_of_a_group_is_several_graphs() -> None:
    ends = []
    for graphs in (Graphs.DRY, Graphs.NONE):
        trainer = updated(trainer_of(small_config("algo.observation_norm=false"), graphs, Echo()), 6)
        ends.append(state_of(trainer.checkpoint()))
    assert differing(*ends) == []


# --- planted faults -----------------------------------------------------------------------------------------------


def test_a_planted_read_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PPOLoss, "_get_entropy", ClipPPOLoss._get_entropy)  # TorchRL's own
    with pytest.raises(DryRunError, match=r"^pace/rl/ppo\.py:\d+: the host reads a tensor"):
        updated(trainer_of(small_config()), 3)


def test_a_planted_number_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    rates = itertools.count(1)

    def adapt(rule: KLAdaptiveRate, kl: Tensor) -> None:
        rule._rate.fill_(next(rates) / 1024)

    monkeypatch.setattr(KLAdaptiveRate, "adapt", adapt)
    with pytest.raises(
        DryRunError, match=r"^pace/rl/ppo\.py:.* aten\.fill_\.Scalar is given 0\.0029.* in place of 0\.0019"
    ):
        trainer_of(small_config()).update()


def test_a_planted_tensor_that_has_moved_is_named() -> None:
    trainer = trainer_of(small_config())
    trainer.update()
    learner = trainer.algorithm.ppo  # type: ignore[attr-defined]
    learner._metrics = learner._metrics.clone()
    with pytest.raises(DryRunError, match=r"^pace/rl/ppo\.py:\d+: aten\.slice.* is given another tensor of shape"):
        trainer.update()


def test_a_fit_that_outlives_its_storage_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    capture, known = PredictorTrainer._capture, set()

    def once(trainer: PredictorTrainer) -> None:
        if trainer not in known:
            capture(trainer)
        known.add(trainer)

    monkeypatch.setattr(PredictorTrainer, "_capture", once)
    config = small_config()
    config.algo.later_steps = [SchedulePoint(3.0 * UPDATE, 8.0)]
    trainer = trainer_of(config)
    with pytest.raises(DryRunError, match=r"^pace/predictor/regression\.py:\d+: aten\.\w+.* is given a"):
        updated(trainer, 6)


def test_a_learning_rate_that_is_lost_in_a_resume_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    load = ppo.load_optimiser_state

    def replacing(optimiser: torch.optim.Optimizer, saved: dict[str, Any]) -> None:
        load(optimiser, saved)
        optimiser.param_groups[0]["lr"] = optimiser.param_groups[0]["lr"].clone()

    monkeypatch.setattr(ppo, "load_optimiser_state", replacing)
    assert any("actor" in name for name in resumed_after(4, 4, small_config()))


# --- the command --------------------------------------------------------------------------------------------------

TRAINED = (
    "device=cpu", "engine.graph=dry", "num_worlds=32", "minutes=0", "progress=false", "tensorboard=false",
    "algo.actor_hidden=[32]", "algo.critic_hidden=[32]", "algo.autocast=mixed", "predictor.batches_per_update=8",
    *IN_SAMPLES,
)  # fmt: skip
CHANGES = (  # 128 control steps an update, 192 later
    "algo.std=[{samples: 256, value: 0.5},{samples: 384, value: 0.2}]", "algo.later_steps=[{samples: 1024, value: 6}]",
    "curriculum=[{samples: 1700, task: ['serve.pause=[0.0,0.3]', 'sensing=wide', 'serve=mixed']}]",
)  # fmt: skip


def train(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["train", *arguments])
    return main()


@pytest.mark.long
def test_the_command_ends_bit_for_bit_as_the_same_run_unreplayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = []
    for name in ("replayed", "plain"):
        out = tmp_path / name
        assert train(monkeypatch, *TRAINED, *CHANGES, f"out={out}", "samples=2400") == 0
        ends.append(state_of(load_checkpoint(out)))
        without_replay(monkeypatch)
    assert len(ends[0]) > 100
    assert differing(*ends) == []
    rows = [read_metrics(tmp_path / name / "metrics.csv") for name in ("replayed", "plain")]
    assert rows[0]["samples"] == rows[1]["samples"] == [*range(128, 1025, 128), *range(1216, 2561, 192)]
    training = load_checkpoint(tmp_path / "replayed").training
    assert training is not None
    assert training["algorithm"]["fine"]  # since the fifth update
    assert rows[0]["stage"] == [0.0] * 12 + [1.0] * 4


@pytest.mark.long
def test_the_command_resumes_exactly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert train(monkeypatch, *TRAINED, f"out={whole}", "samples=1024") == 0
    assert train(monkeypatch, *TRAINED, f"out={parts}", "samples=512") == 0
    assert train(monkeypatch, f"resume={parts}", "samples=1024", "progress=false") == 0
    assert differing(state_of(load_checkpoint(whole)), state_of(load_checkpoint(parts))) == []
    assert train(monkeypatch, f"resume={parts}", "samples=1152", "progress=false", "engine.graph=auto") == 0
