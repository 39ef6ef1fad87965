"""Training under faults: kills, signals, full and read-only disks, deleted folders. Nothing written is lost."""

from __future__ import annotations

import multiprocessing
import os
import random
import shutil
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from pace.config.base import ConfigError
from pace.rl.train import main
from pace.runs.checkpoint import CheckpointError, find_checkpoint, load_checkpoint
from pace.runs.checkpoint_folders import FOLDER, list_checkpoints, update_of
from pace.runs.run_folder import RunFolder
from tests.helpers.outside import SMALL, command
from tests.helpers.training import assert_same_run, dummy_trainer, rows_of

ROOT = Path(__file__).parents[2]
FORK = multiprocessing.get_context("fork")


@pytest.fixture
def mount(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mounts a file system in memory, with options, in a new folder; again with others."""
    disk = tmp_path / "disk"
    disk.mkdir()

    def mounted(options: str) -> Path:
        kind = ["-t", "tmpfs", "tmpfs"] if "remount" not in options else []
        done = subprocess.run(["mount", *kind, "-o", options, disk], capture_output=True, check=False)
        if done.returncode != 0:
            pytest.skip("this machine lets no test mount")
        return disk

    yield mounted
    subprocess.run(["umount", "-l", disk], capture_output=True, check=False)


def train(path: Path, updates: int, resume: bool) -> None:
    torch.set_num_threads(1)
    dummy_trainer(path, updates, resume).train()


def is_saving(run: Path) -> bool:
    return any((run / FOLDER).glob(".*.tmp")) if (run / FOLDER).is_dir() else False


@pytest.mark.long
def test_killed_at_any_moment_a_run_resumes_bit_for_bit(tmp_path: Path) -> None:
    """Every second kill falls into the writing of a checkpoint, or close to it."""
    updates, generator = 60, random.Random(5)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    train(whole, updates, resume=False)
    kills = 0
    while kills < 5:
        began = list_checkpoints(broken)
        process = FORK.Process(target=train, args=(broken, updates, bool(began)))
        process.start()
        while process.is_alive() and list_checkpoints(broken) == began:
            time.sleep(0.001)
        deadline = time.monotonic() + generator.uniform(0.0, 0.1)
        while process.is_alive() and time.monotonic() < deadline and not (kills % 2 and is_saving(broken)):
            time.sleep(0.0005)
        process.kill()
        process.join()
        kills += 1
        for checkpoint in list_checkpoints(broken):
            load_checkpoint(checkpoint)  # whole, whatever the moment
    assert load_checkpoint(broken).counters["updates"] < updates
    train(broken, updates, resume=True)
    assert_same_run(whole, broken)
    assert not is_saving(broken)


@pytest.mark.slow
def test_a_terminated_run_has_saved_and_says_so_with_its_status(tmp_path: Path) -> None:
    run = tmp_path / "run"
    arguments = [*(each for each in SMALL if not each.startswith("samples")), "processes=1", "minutes=0"]
    process = start(*arguments, f"out={run}", "samples=inf")
    wait_for_rows(run, process)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 75, err
    assert "stopped by SIGTERM" in out
    assert load_checkpoint(run).counters["updates"] == len(rows_of(run))


def start(*arguments: str, **options: object) -> subprocess.Popen[str]:
    line = [sys.executable, "-m", "pace.rl.train", *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    return subprocess.Popen(line, env=environment, text=True, **piped)  # type: ignore[call-overload]


def wait_for_rows(run: Path, process: subprocess.Popen[str], rows: int = 1) -> None:
    while process.poll() is None:
        if (run / "metrics.csv").exists() and len(rows_of(run)) >= rows:
            return
        time.sleep(0.02)
    raise AssertionError(process.communicate())


def test_a_signal_that_is_ignored_stays_so(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    try:
        trainer = dummy_trainer(tmp_path, 2)
        advance = trainer.env.advance

        def lost(action: torch.Tensor) -> None:
            os.kill(os.getpid(), signal.SIGHUP)
            advance(action)

        trainer.env.advance = lost  # type: ignore[method-assign]
        summary = trainer.train()
    finally:
        signal.signal(signal.SIGHUP, before)
    assert summary is not None
    assert summary.reason.startswith("samples=")


def test_a_full_disk_is_told_and_the_run_goes_on(
    mount: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = mount("size=2m") / "run"
    trainer = dummy_trainer(run, 8)
    save, filling = trainer.save, run.parent / "filling"

    def fill(last: bool = False) -> Path | None:
        if trainer.updates == 3:
            left = os.statvfs(run)
            filling.write_bytes(bytes(left.f_bavail * left.f_frsize))
        if trainer.updates == 6:
            filling.unlink()
        return save(last)

    trainer.save = fill  # type: ignore[method-assign]
    trainer.train()
    said = capsys.readouterr().err
    assert "update_00000003 cannot be written: " in said
    assert "No space left on device (os error 28); training goes on, the last checkpoint stays" in said
    assert "update_00000006" not in said
    assert [folder.name[-1] for folder in list_checkpoints(run)] == ["2", "6", "7", "8"]
    dummy_trainer(tmp_path / "whole", 8).train()
    assert_same_run(tmp_path / "whole", run)


def test_a_disk_that_stays_full_ends_with_the_last_good_checkpoint(
    mount: Callable[[str], Path], tmp_path: Path
) -> None:
    run = mount("size=2m") / "run"
    dummy_trainer(run, 2).train()
    left = os.statvfs(run)
    (run.parent / "filling").write_bytes(bytes(left.f_bavail * left.f_frsize))
    with pytest.raises(ConfigError, match=r"cannot be written: No space left|cannot be made: No space left"):
        dummy_trainer(run, 4, resume=True).train()
    assert [row["update"] for row in rows_of(run)] == ["1", "2"]
    (run.parent / "filling").write_bytes(bytes(left.f_bavail * left.f_frsize - 40_000))
    with pytest.raises(CheckpointError, match=r"update_00000004 cannot be written: .*No space left on device"):
        dummy_trainer(run, 4, resume=True).train()
    assert load_checkpoint(run).counters["updates"] == 2
    (run.parent / "filling").unlink()
    dummy_trainer(run, 4, resume=True).train()
    dummy_trainer(tmp_path / "whole", 4).train()
    assert_same_run(tmp_path / "whole", run)


def test_a_read_only_disk_is_one_line(mount: Callable[[str], Path], capsys: pytest.CaptureFixture[str]) -> None:
    disk = mount("size=4m")
    dummy_trainer(disk / "run", 1).train()
    mount("remount,ro")
    assert find_checkpoint(disk / "run").name == "update_00000001"
    for out in (disk / "run", disk / "new"):
        assert command(main, *SMALL, f"out={out}") == 2
        assert "Read-only file system" in capsys.readouterr().err


def test_a_folder_that_is_deleted_under_the_run_is_made_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, trainer = tmp_path / "run", dummy_trainer(tmp_path / "run", 6)
    update = trainer.update

    def deleted() -> dict[str, float]:
        if trainer.updates == 2:
            shutil.rmtree(run)
        return update()

    trainer.update = deleted  # type: ignore[method-assign]
    summary = trainer.train()
    assert summary is not None
    assert summary.updates == 6
    assert [row["update"] for row in rows_of(run)] == ["3", "4", "5", "6"]
    assert load_checkpoint(run).counters["updates"] == 6
    assert "was deleted" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="has a checkpoint of update 6"):  # it is guarded again
        RunFolder(run, {}, False)


def test_a_clock_that_jumps_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jumps = iter(range(10**6))
    monkeypatch.setattr(time, "time", lambda: 1e9 - 86_400.0 * next(jumps))
    dummy_trainer(tmp_path / "run", 3, tensorboard=True).train()
    assert len(rows_of(tmp_path / "run")) == 3


def test_others_can_read_a_checkpoint_as_far_as_the_user_lets_them(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        dummy_trainer(tmp_path / "run", 1).train()
    finally:
        os.umask(before)
    modes = {stat.S_IMODE(file.stat().st_mode) for file in find_checkpoint(tmp_path / "run").iterdir()}
    assert modes == {0o640}


LEARNER = ("algo.steps=12", "algo.actor_hidden=[32]", "algo.critic_hidden=[32]", "predictor.batches_per_update=2")
#: A run of some minutes on a busy machine would be judged, and its metrics would have what a short one's have not.
TINY = ("num_worlds=8", "engine.threads=1", "minutes=0", "tensorboard=true", "judge.after=1e6", *LEARNER)


@pytest.mark.slow
def test_workers_end_with_their_true_status(tmp_path: Path) -> None:
    """They aborted at their end, and nobody looked."""
    process = start(*TINY, "processes=2", "samples=96", f"out={tmp_path / 'run'}", "progress=false")
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert "1 updates" in out
    assert "ended with status" not in err


@pytest.mark.long
@pytest.mark.parametrize("processes", [1, 2])
def test_real_runs_killed_at_random_moments_resume_bit_for_bit(tmp_path: Path, processes: int) -> None:
    """20 kills of the real command, with the native engine; a third of them while a checkpoint is written."""
    updates, generator = 150, random.Random(processes)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    limits = (f"samples={updates * 96}", "minutes=0", "checkpoint_minutes=0", "progress=false")
    first = start(*TINY, *limits, f"processes={processes}", f"out={whole}")
    assert first.wait(900) == 0
    kills = 0
    while kills < 20:
        began = list_checkpoints(broken)
        arguments = (f"resume={broken}",) if began else (*TINY, f"processes={processes}", f"out={broken}")
        process = start(*arguments, *limits, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if generator.random() < 0.8:  # else it may end before its first update
            while process.poll() is None and list_checkpoints(broken) == began:
                time.sleep(0.005)
        deadline = time.monotonic() + generator.uniform(0.0, 1.0)
        during_a_save = kills % 3 == 0
        most = updates * (kills + 1) // 22  # so that the run does not end before its last kill
        while process.poll() is None and time.monotonic() < deadline and not (during_a_save and is_saving(broken)):
            if any(update_of(checkpoint) >= most for checkpoint in list_checkpoints(broken)):
                break
            time.sleep(0.0005)
        assert process.poll() is None, f"it ended before kill {kills + 1}: give it more updates"
        process.kill()
        process.wait()
        kills += 1
        for checkpoint in list_checkpoints(broken):
            load_checkpoint(checkpoint)
    assert kills == 20
    assert start(f"resume={broken}", *limits).wait(900) == 0
    assert_same_run(whole, broken)
    assert not is_saving(broken)
