"""One update: the host reads once, a fault is found at its end, and the number format changes once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from pace.config.base import to_dict
from pace.config.schedules import SchedulePoint
from pace.config.training import AlgoConfig, TrainConfig, load_train_config
from pace.predictor.network import PredictorNetwork
from pace.rl.ppo import AsymmetricPPO
from pace.rl.rollout import RolloutError
from pace.rl.trainer import Trainer
from pace.runs.checkpoint import load_checkpoint
from pace.runs.checkpoint_folders import list_checkpoints
from pace.runs.run_folder import RunFolder
from tests.helpers.dummy import DummyTask

WORLDS = 16
SMALL = (
    f"num_worlds={WORLDS}", "samples=1e9", "algo.steps=6", "algo.actor_hidden=[16]", "algo.critic_hidden=[16]",
    "predictor.batches_per_update=2", "tensorboard=false", "progress=false",
)  # fmt: skip


def small_config(*overrides: str) -> TrainConfig:
    return load_train_config([*SMALL, *overrides])


def trainer_of(config: TrainConfig, path: Path | None = None) -> Trainer:
    torch.manual_seed(3)
    run = RunFolder(path, to_dict(config), False) if path else None
    return Trainer(config, DummyTask(WORLDS), PredictorNetwork(config.predictor), run)


def ppo_of(trainer: Trainer) -> AsymmetricPPO:
    assert isinstance(trainer.algorithm, AsymmetricPPO)
    return trainer.algorithm


class Reads(TorchDispatchMode):
    """Operators whose result, or its shape, the host waits for."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        if name.startswith(("_local_scalar_dense", "nonzero", "masked_select", "unique", "equal")):
            self.found.append(name)
        return func(*args, **(kwargs or {}))


def test_the_host_reads_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the copy of the weights that a fault would need."""
    trainer = trainer_of(small_config())
    for _ in range(2):  # the second copies what the first has made
        trainer._safe_update()
    with Reads() as reads:
        for name in ("tolist", "numpy", "cpu", "__array__", "item"):
            method = getattr(torch.Tensor, name)

            def noted(tensor: Any, *args: Any, name: str = name, method: Any = method) -> Any:
                reads.found.append(name)
                return method(tensor, *args)

            monkeypatch.setattr(torch.Tensor, name, noted)
        trainer._safe_update()
    assert reads.found == ["tolist"]


def test_a_loss_that_is_not_finite_ends_the_run_and_good_weights_are_kept(tmp_path: Path) -> None:
    trainer = trainer_of(small_config("checkpoint_minutes=0", "algo.skips=0"), tmp_path)
    finish, calls, good = ppo_of(trainer).finish, [], {}

    def poisoned() -> None:
        finish()
        calls.append(None)
        if len(calls) == 3:
            good.update({name: value.clone() for name, value in trainer.agent.state_dict().items() if "layers" in name})
            ppo_of(trainer).storage().advantage[0, 0] = math.nan

    trainer.algorithm.finish = poisoned  # type: ignore[method-assign]
    with pytest.raises(RolloutError, match=r"not finite: kl of the update; the weights before .*last_good"):
        trainer.train()
    assert load_checkpoint(tmp_path).counters["updates"] == len(list_checkpoints(tmp_path)) == 2
    kept = load_checkpoint(tmp_path / "last_good")
    assert kept.counters["updates"] == 2
    for name, value in good.items():
        assert torch.equal(kept.weights["agent"][name], value)
        assert torch.equal(trainer.agent.state_dict()[name], value)


def test_weights_that_the_fit_of_the_predictor_has_spoilt_end_the_run() -> None:
    trainer = trainer_of(small_config())
    trainer.update()
    with torch.no_grad():
        trainer.regression.optimiser.param_groups[0]["lr"].fill_(math.inf)
    with pytest.raises(RolloutError, match="the weights after the update"):
        trainer.update()


def flapping(monkeypatch: pytest.MonkeyPatch) -> AlgoConfig:
    """An upper limit of the std that passes ``fp32_below`` in the second update and rises again."""
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    config = small_config("algo.autocast=auto", "algo.fp32_below=0.2", "algo.std_floor=0.01").algo
    values = (0.5, 0.5, 0.15, 0.5)
    config.std = [SchedulePoint(96.0 * index, value) for index, value in enumerate(values)]
    return config


def test_the_number_format_changes_once_and_a_resumed_run_knows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    config = small_config()
    config.algo = flapping(monkeypatch)
    trainer, formats = trainer_of(config), []
    for _ in range(5):
        trainer.update()
        formats.append(ppo_of(trainer).storage().policy.dtype)
        with torch.no_grad():  # what the entropy would do
            ppo_of(trainer).agent.actor.spread.state_independent_scale.fill_(math.log(0.5))
    assert formats == [torch.bfloat16] * 3 + [torch.float32] * 2
    resumed = trainer_of(config)
    resumed.resume(trainer.checkpoint())
    assert ppo_of(resumed).agent.observation_dtype == torch.float32
    resumed.update()
    assert ppo_of(resumed).storage().policy.dtype == torch.float32
    older = trainer.checkpoint()
    assert older.training is not None
    del older.training["algorithm"]["fine"]
    again = trainer_of(config)
    again.resume(older)
    assert ppo_of(again).agent.observation_dtype == torch.bfloat16  # as it was chosen: by the std of 0.5
