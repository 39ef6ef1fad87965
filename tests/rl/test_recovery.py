"""Updates that are not finite: undone bit for bit, counted, told, and the end of a run after too many."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from pace.rl.recovery import LastGood
from pace.rl.rollout import RolloutError
from pace.rl.trainer import Trainer
from pace.runs.checkpoint import CheckpointError, load_checkpoint
from pace.runs.checkpoint_folders import list_checkpoints
from pace.runs.optimiser import load_optimiser_state, optimiser_state
from tests.helpers.training import UPDATE, assert_same, dummy_trainer, rows_of


class Learner:
    """A network and its optimiser."""

    def __init__(self) -> None:
        torch.manual_seed(1)
        self.network = nn.Linear(3, 2)
        self.adam = torch.optim.Adam(self.network.parameters(), lr=0.1)

    def learn(self, factor: float = 1.0) -> None:
        self.adam.zero_grad()
        (factor * self.network(torch.ones(4, 3))).square().mean().backward()
        self.adam.step()

    def state_dict(self) -> dict:
        return optimiser_state(self.adam)

    def load_state_dict(self, state: dict) -> None:
        load_optimiser_state(self.adam, state)


def test_the_state_before_an_update_comes_back_bit_for_bit() -> None:
    first, second = Learner(), Learner()
    good = LastGood({"network": first.network}, {"learner": first})
    for learner in (first, second):
        learner.learn()
    good.keep()
    for _ in range(2):  # more than once: what is put back is a copy
        first.learn(float("nan"))
        assert not bool(first.network.weight.isfinite().all())
        good.restore()
    for learner in (first, second):
        learner.learn()
        learner.learn()
    assert_same(first.network.state_dict(), second.network.state_dict())
    assert_same(first.state_dict(), second.state_dict())


def test_before_the_first_update_there_is_nothing_but_weights() -> None:
    first, second = Learner(), Learner()
    good = LastGood({"network": first.network}, {"learner": first})
    good.keep()
    first.learn(float("inf"))
    good.restore()
    for learner in (first, second):
        learner.learn()
    assert_same(first.network.state_dict(), second.network.state_dict())


def spoil_observation(trainer: Trainer) -> None:
    trainer.env.critic_observation[3, 1] = torch.nan


def spoil_reward(trainer: Trainer) -> None:
    advance = trainer.env.advance

    def spoilt(action: Tensor) -> None:
        advance(action)
        trainer.env.reward[5] = torch.inf
        trainer.env.advance = advance  # type: ignore[method-assign]

    trainer.env.advance = spoilt  # type: ignore[method-assign]


def spoil_gradient(trainer: Trainer) -> None:
    weight = next(trainer.algorithm.agent.parameters())  # type: ignore[attr-defined]

    def spoilt(gradient: Tensor) -> Tensor:
        hook.remove()
        return gradient * torch.nan

    hook = weight.register_hook(spoilt)


@pytest.mark.parametrize("spoil", [spoil_observation, spoil_reward, spoil_gradient])
def test_one_update_that_is_not_finite_is_skipped_and_the_run_goes_on(
    spoil: Callable[[Trainer], None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer = dummy_trainer(tmp_path, 6)
    update = trainer.update
    before: dict[str, Tensor] = {}

    def spoilt() -> dict[str, float]:
        if trainer.updates == 2:
            before.update({name: value.clone() for name, value in trainer.agent.state_dict().items()})
            spoil(trainer)
        if trainer.updates == 3:
            assert_same(trainer.agent.state_dict(), before)
        return update()

    trainer.update = spoilt  # type: ignore[method-assign]
    summary = trainer.train()
    assert summary is not None
    assert (summary.updates, summary.samples, summary.faults) == (6, 6 * UPDATE, ["1 updates skipped"])
    rows = rows_of(tmp_path)
    assert [row["skipped"] for row in rows] == ["0", "0", "1", "0", "0", "0"]
    assert rows[2]["kl"] == rows[2]["mean_reward"] == ""
    assert all(row["mean_reward"] != "" for row in rows[3:])
    assert "warning: update 3 is skipped: not finite" in capsys.readouterr().err
    for checkpoint in list_checkpoints(tmp_path):
        weights = load_checkpoint(checkpoint).weights["agent"]
        assert all(bool(value.isfinite().all()) for value in weights.values())
    assert [folder.name[-1] for folder in list_checkpoints(tmp_path)] == ["2", "4", "5", "6"]  # none of the skipped one


def test_a_run_ends_after_too_many_with_the_last_good_checkpoint(tmp_path: Path) -> None:
    trainer = dummy_trainer(tmp_path, 20)
    trainer.config.algo.skips = 3
    update = trainer.update

    def spoilt() -> dict[str, float]:
        if trainer.updates >= 4:
            spoil_observation(trainer)
        return update()

    trainer.update = spoilt  # type: ignore[method-assign]
    with pytest.raises(RolloutError, match=r"not finite: .*; the weights before this update are in .*last_good"):
        trainer.train()
    assert [row["skipped"] for row in rows_of(tmp_path)] == ["0"] * 4 + ["1"] * 3
    good, newest = load_checkpoint(tmp_path / "last_good"), load_checkpoint(tmp_path)
    assert good.counters["updates"] == newest.counters["updates"] == 4
    assert_same(good.weights, newest.weights)
    again = dummy_trainer(tmp_path, 6, resume=True)  # from there the run can go on
    assert again.train() is not None


def test_the_last_words_of_a_run_on_a_full_disk_are_its_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = dummy_trainer(tmp_path, 20)
    trainer.config.algo.skips = 0
    spoil_observation(trainer)

    def full(*_: object) -> Path:
        raise CheckpointError("last_good cannot be written: No space left on device")

    monkeypatch.setattr("pace.rl.recovery.save_checkpoint", full)
    with pytest.raises(RolloutError, match=r"not finite: .* could not be saved: .*No space left"):
        trainer.train()


@pytest.mark.parametrize("first_bad", [1, 4])
def test_a_full_memory_of_the_gpu_is_one_line_and_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first_bad: int
) -> None:
    monkeypatch.setattr("torch.cuda.mem_get_info", lambda _: (2**30, 24 * 2**30))
    trainer = dummy_trainer(tmp_path, 20)
    update, before = trainer.update, {}

    def full() -> dict[str, float]:
        if trainer.updates == first_bad - 1:
            before.update({name: value.clone() for name, value in trainer.agent.state_dict().items()})
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9.00 GiB")
        return update()

    trainer.update = full  # type: ignore[method-assign]
    if first_bad == 1:  # there is nothing to save yet; the command says the line
        with pytest.raises(torch.OutOfMemoryError):
            trainer.train()
        return
    text = r"the GPU's memory is full \(24\.0 GiB, 1\.0 free\): by estimate .* of 34,304 worlds fits .*last_good"
    with pytest.raises(RolloutError, match=text):
        trainer.train()
    good = load_checkpoint(tmp_path / "last_good")
    assert good.counters["updates"] == first_bad - 1
    assert_same(good.weights["agent"], before)
