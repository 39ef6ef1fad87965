"""``python -m pace.rl.train`` itself: a short real run, its exact resume, and one line for each kind of wrong input."""

from __future__ import annotations

import math
import os
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pace.config.judge import JudgeConfig
from pace.rl.closing import close
from pace.rl.policies import load_policy
from pace.rl.train import main
from pace.rl.trainer import Summary, Trainer
from pace.runs.checkpoint import load_checkpoint
from pace.runs.metrics import read_metrics
from tests.helpers.algo import IN_SAMPLES

WORLDS = 8
UPDATE = WORLDS * 12
SMALL = (
    "algo.steps=12",
    "algo.actor_hidden=[32]",
    "algo.critic_hidden=[32]",
    "predictor.batches_per_update=2",
    "progress=false",
    *IN_SAMPLES,
)


@pytest.fixture
def train(monkeypatch: pytest.MonkeyPatch):
    """Run the command with arguments, in this process; returns its exit status."""

    def run(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["train", *arguments])
        return main()

    return run


def real_run(train, path: Path, updates: int, *arguments: str) -> int:
    return train(f"num_worlds={WORLDS}", f"samples={updates * UPDATE}", f"out={path}", *SMALL, *arguments)


@pytest.mark.slow
def test_real_updates_and_an_exact_resume(train, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert real_run(train, tmp_path / "whole", 4) == 0
    printed = capsys.readouterr().out
    assert "4 updates" in printed
    for name in ("metrics.csv", "learning_curve.png"):
        assert f"wrote {tmp_path / 'whole' / name}" in printed
    assert real_run(train, tmp_path / "parts", 2) == 0
    assert train(f"resume={tmp_path / 'parts'}", f"samples={4 * UPDATE}", "progress=false") == 0
    whole, parts = load_checkpoint(tmp_path / "whole"), load_checkpoint(tmp_path / "parts")
    assert parts.counters["updates"] == 4
    for part, tensors in whole.weights.items():
        for name, tensor in tensors.items():
            assert torch.equal(tensor, parts.weights[part][name]), f"{part} {name}"
    rewards = [read_metrics(tmp_path / run / "metrics.csv")["mean_reward"] for run in ("whole", "parts")]
    assert rewards[0] == rewards[1]
    assert len(set(rewards[0])) == 4


@pytest.mark.slow
def test_a_run_closes_with_what_the_policy_does_without_exploration(
    train, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = [f"judge.{name}=4" for name in ("serves", "worlds", "last_serves", "last_worlds")]
    few += ["judge.after=0", "judge.physics_dt=0.01", "judge.warmup_serves=0", "judge.video=0.2"]
    assert real_run(train, tmp_path, 3, "checkpoint_minutes=0", *few) == 0
    printed = capsys.readouterr().out
    assert "4 mixed serves" in printed
    assert "the paper" in printed
    assert f"wrote {tmp_path / 'play.mp4'}" in printed or "no video: " in printed
    assert f"next: pace play {tmp_path} | pace evaluate {tmp_path} | pace export {tmp_path}" in printed
    assert (tmp_path / "evaluation" / "evaluation.json").is_file()
    judged = read_metrics(tmp_path / "metrics.csv")["eval_hit"]
    assert math.isnan(judged[0])
    assert all(0.0 <= share <= 1.0 for share in judged[1:])


def test_ctrl_c_leaves_the_judgement_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    class Slow:
        def quick(self, checkpoint: Path, minutes: float) -> dict[str, float]:
            raise AssertionError(checkpoint, minutes)

        def last(self, run: Path, minutes: float) -> None:
            raise KeyboardInterrupt(run, minutes)

    def film(run: Path, seconds: float) -> None:
        raise AssertionError(run, seconds)

    summary = Summary("done", 3, 100, 90.0, tmp_path / "checkpoints" / "update_00000003", None, {}, [])
    close(Slow(), film, summary, JudgeConfig())
    assert "left out; the run is complete" in capsys.readouterr().out
    close(Slow(), film, replace(summary, seconds=59.0), JudgeConfig())  # a run of less than a minute
    assert capsys.readouterr().out == ""


def test_init_from_starts_a_new_run_with_the_weights(train, tmp_path: Path) -> None:
    assert real_run(train, tmp_path / "old", 1) == 0
    assert real_run(train, tmp_path / "new", 1, f"init_from={tmp_path / 'old'}") == 0
    old, new = load_checkpoint(tmp_path / "old"), load_checkpoint(tmp_path / "new")
    assert new.counters["updates"] == 1
    assert new.weights["agent"]["policy_norm.count"].item() == 2 * UPDATE
    change = new.weights["agent"]["critic.layers.0.weight"] - old.weights["agent"]["critic.layers.0.weight"]
    assert 0.0 < change.abs().max().item() < 0.1


@pytest.mark.slow
def test_a_policy_can_go_on_with_another_predictor(train, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert real_run(train, tmp_path / "policy", 1) == 0
    assert real_run(train, tmp_path / "filter", 1, "predictor=filter") == 0
    begin = ["predictor=filter", f"init_from={tmp_path / 'policy'}"]
    assert real_run(train, tmp_path / "new", 1, *begin) == 1
    assert "predictor_from=RUN" in capfd.readouterr().err
    assert real_run(train, tmp_path / "new", 1, *begin, f"predictor_from={tmp_path / 'filter'}") == 0
    new, policy, flight = (load_checkpoint(tmp_path / name).weights for name in ("new", "policy", "filter"))
    for part, name, like in (("agent", "actor.mlp.layers.0.weight", policy), ("predictor", "layers.0.weight", flight)):
        change = (new[part][name] - like[part][name]).abs().max().item()
        assert 0.0 < change < 0.1


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["no_such_key=1"], 2, "no_such_key"),
        (["algo=no_such_group"], 2, "algo/no_such_group"),
        (["num_worlds=0"], 2, "num_worlds must be at least 1"),
        (["num_worlds=many"], 2, "num_worlds"),
        (["algo.gamma=2"], 2, "algo.gamma"),
        (["device=cuda:31"], 2, "cuda:31"),
        (["resume=no/such/run"], 1, "no/such/run does not exist"),
        (["init_from=tests"], 1, "neither a run folder nor a checkpoint"),
        (["resume=a", "init_from=b"], 2, "not both"),
        (["predictor_from=tests"], 1, "neither a run folder nor a checkpoint"),
    ],
)
def test_wrong_input_is_one_line(train, capfd: pytest.CaptureFixture[str], arguments, status, words) -> None:
    assert train(*arguments, "num_worlds=4" if "num_worlds" not in arguments[0] else "progress=false") == status
    lines = [line for line in capfd.readouterr().err.splitlines() if not line.startswith("Warp")]
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert words in lines[0]


def test_a_resumed_run_keeps_its_task(train, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert real_run(train, tmp_path, 1) == 0
    assert train(f"resume={tmp_path}", "algo.gamma=0.9") == 2
    assert "'algo.gamma' cannot change in a resumed run" in capsys.readouterr().err
    assert train(f"resume={tmp_path}", "progress=false") == 2
    assert "give samples= above that" in capsys.readouterr().err


def test_a_run_that_was_moved_goes_on_where_it_lies(train, tmp_path: Path) -> None:
    assert real_run(train, tmp_path / "old", 1) == 0
    (tmp_path / "old").rename(tmp_path / "moved")
    assert train(f"resume={tmp_path / 'moved'}", f"samples={2 * UPDATE}", "progress=false") == 0
    assert not (tmp_path / "old").exists()
    assert read_metrics(tmp_path / "moved" / "metrics.csv")["update"] == [1, 2]


def test_a_run_does_not_mix_with_another_in_its_folder(
    train, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert real_run(train, tmp_path, 2, "checkpoint_minutes=0") == 0
    metrics = (tmp_path / "metrics.csv").read_text()
    first = tmp_path / "checkpoints" / "update_00000001"
    assert real_run(train, tmp_path, 1) == 2
    assert f"resume={tmp_path} continues it" in capsys.readouterr().err
    assert train(f"resume={first}", f"samples={3 * UPDATE}", "progress=false") == 2
    assert "checkpoint of update 2" in capsys.readouterr().err
    assert (tmp_path / "metrics.csv").read_text() == metrics


def test_a_folder_that_cannot_be_made_is_one_line(train, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert real_run(train, tmp_path / "file" / "run", 1) == 2
    assert "cannot be made: Not a directory" in capsys.readouterr().err


def snapshot(folder: Path) -> dict[str, bytes]:
    """All files in a folder."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_a_colleagues_checkpoint_is_resumed_into_a_new_run(
    train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Bit for bit as the run itself would have continued; nothing that lies around it is touched."""
    monkeypatch.chdir(tmp_path)
    assert real_run(train, tmp_path / "theirs", 1, "checkpoint_minutes=0", "name=theirs") == 0
    mine = tmp_path / "project" / "checkpoints"  # as if it were a run
    mine.mkdir(parents=True)
    shutil.copytree(tmp_path / "theirs" / "checkpoints" / "update_00000001", mine / "update_00000001")
    shutil.copytree(mine / "update_00000001", tmp_path / "project" / "from_colleague")
    (tmp_path / "project" / "config.yaml").write_text("my: own settings\n")
    (tmp_path / "project" / "metrics.csv").write_text("day,weight\n1,70\n")
    before = snapshot(tmp_path / "project")
    limits = (f"samples={2 * UPDATE}", "progress=false")
    assert train(f"resume={tmp_path / 'project' / 'from_colleague'}", *limits) == 0
    assert train(f"resume={mine / 'update_00000001'}", *limits, "out=second") == 0
    assert train(f"resume={tmp_path / 'theirs'}", *limits, "out=third") == 0
    assert snapshot(tmp_path / "project") == before
    assert [path.name for path in (tmp_path / "theirs" / "checkpoints").iterdir()] == ["update_00000001"]
    assert real_run(train, tmp_path / "theirs", 2, "name=theirs") == 2  # its own folder: resume continues it
    assert train(f"resume={tmp_path / 'theirs'}", *limits) == 0
    expected = load_checkpoint(tmp_path / "theirs")
    (new,) = (tmp_path / "runs").iterdir()
    assert new.name.endswith("_theirs")
    for run in (new, Path("second"), Path("third")):
        found = load_checkpoint(run)
        assert found.config["out"] == str(run.relative_to(tmp_path) if run.is_absolute() else run)
        assert found.counters["updates"] == 2
        for part, tensors in expected.weights.items():
            assert all(torch.equal(tensor, found.weights[part][name]) for name, tensor in tensors.items())
        assert read_metrics(run / "metrics.csv")["update"] == [2]
    capsys.readouterr()
    assert load_policy("project/from_colleague").counters["updates"] == 1
    assert real_run(train, tmp_path / "begun", 1, "init_from=project/from_colleague") == 0


def test_a_run_that_is_copied_resumes_where_it_lies(train, tmp_path: Path) -> None:
    assert real_run(train, tmp_path / "a", 1) == 0
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    assert train(f"resume={tmp_path / 'b' / 'checkpoints' / 'update_00000001'}", f"samples={2 * UPDATE}") == 0
    assert load_checkpoint(tmp_path / "b").counters["updates"] == 2
    assert load_checkpoint(tmp_path / "a").counters["updates"] == 1


def test_a_run_without_an_end_says_so_and_ends_with_ctrl_c(
    train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("pace.runs.progress.SECONDS_PER_LINE", 0.0)
    update, count = Trainer.update, 0

    def stopped(self: Trainer) -> dict[str, float]:
        nonlocal count
        count += 1
        if count == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return update(self)

    monkeypatch.setattr(Trainer, "update", stopped)
    small = [argument for argument in SMALL if not argument.startswith("progress")]
    assert train(f"num_worlds={WORLDS}", "samples=inf", "minutes=0", f"out={tmp_path}", *small) == 0
    printed = capsys.readouterr().out
    assert "--:-- left" in printed
    assert "stopped by SIGINT: 3 updates" in printed
    assert load_checkpoint(tmp_path).counters["updates"] == 3
    assert load_checkpoint(tmp_path).config["samples"] == float("inf")
