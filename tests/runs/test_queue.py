"""A queue of runs, played by a stand-in for the training: what fails, what goes on, what Ctrl-C leaves behind."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from pace.config.base import ConfigError, to_dict
from pace.config.training import load_train_config
from pace.config.upgrade import FORMAT
from pace.runs import queue as run_queue
from pace.runs.queue import Run, RunQueue, check_settings, logged_samples, shares_of_cores

STAND_IN = Path(__file__).parents[1] / "helpers" / "stand_in.py"


@pytest.fixture(autouse=True)
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_queue, "TRAIN", (sys.executable, str(STAND_IN)))
    monkeypatch.setattr(run_queue, "POLL_SECONDS", 0.02)


def make_run(folder: Path, experiment: str = "plain", samples: float = 4000.0) -> Run:
    return Run(folder / f"{experiment}_seed1", (f"experiment={experiment}", "seed=1"), samples)


def test_a_failed_run_does_not_lose_the_others_and_is_tried_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [make_run(tmp_path, name) for name in ("fails", "one", "two")]
    queue = RunQueue(runs, 2, progress=False)
    queue.play()
    assert queue.failures == {"fails_seed1": "status 1: error: it fell over"}
    assert [run.saved_samples() for run in runs] == [1000, 4000, 4000]
    assert "fails_seed1: FAILED, status 1: error: it fell over" in capsys.readouterr().out
    again = RunQueue(runs, 2, progress=False)
    again.play()
    assert again.failures == {}
    assert all(run.finished for run in runs)
    told = {run.name: run.log.read_text().splitlines() for run in runs}
    assert told["one_seed1"] == [
        f"experiment=one seed=1 out='{tmp_path}/one_seed1' samples=4000.0 minutes=0 progress=false"
    ]
    assert told["fails_seed1"][2:] == [f"resume='{tmp_path}/fails_seed1' samples=4000.0 minutes=0 progress=false"]


def test_more_samples_take_finished_runs_up_again(tmp_path: Path) -> None:
    RunQueue([make_run(tmp_path)], 1, progress=False).play()
    longer = make_run(tmp_path, samples=6000.0)
    assert not longer.finished
    RunQueue([longer], 1, progress=False).play()
    assert longer.saved_samples() == 6000


def test_a_run_that_ends_too_early_has_failed(tmp_path: Path) -> None:
    queue = RunQueue([make_run(tmp_path, samples=4500.0)], 1, progress=False)  # the stand-in plays whole rows
    queue.play()
    assert queue.failures == {"plain_seed1": "ended at 4,000 control steps"}


def test_ctrl_c_saves_what_runs_and_starts_nothing_more(tmp_path: Path) -> None:
    runs = [make_run(tmp_path, "slow"), make_run(tmp_path, "later")]

    def press() -> None:
        while not (runs[0].folder / "ready").exists():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    threading.Thread(target=press).start()
    queue = RunQueue(runs, 1, progress=False)
    with pytest.raises(KeyboardInterrupt):
        queue.play()
    assert signal.getsignal(signal.SIGINT) == before
    assert [run.saved_samples() for run in runs] == [2000, 0]
    assert not runs[1].log.exists()
    assert queue.failures == {}
    RunQueue(runs, 1, progress=False).play()
    assert all(run.finished for run in runs)


def test_progress_is_shown(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    runs = [make_run(tmp_path, name) for name in ("one", "two")]
    RunQueue(runs, 1).play()
    last = capfd.readouterr().err.split("\r")[-1]
    assert "100%" in last
    assert "00:00 left" in last
    assert "2/2 runs" in last


def test_logged_samples_are_those_of_the_last_row(tmp_path: Path) -> None:
    assert logged_samples(tmp_path) == 0
    file = tmp_path / "metrics.csv"
    file.write_text("update,samples,wall_s\n")
    assert logged_samples(tmp_path) == 0
    rows = [f"{u},{u * 4096},1.5," + "0.123456," * 60 for u in range(1, 300)]
    file.write_text("update,samples,wall_s\n" + "\n".join(rows) + "\n")
    assert logged_samples(tmp_path) == 299 * 4096


def test_cores_are_shared_out() -> None:
    cores = sorted(os.sched_getaffinity(0))
    assert sorted(core for share in shares_of_cores(len(cores)) for core in share) == cores
    assert shares_of_cores(1) == [cores]
    assert all(len(share) == 1 for share in shares_of_cores(2 * len(cores)))


def test_a_run_of_other_settings_is_not_taken_up(tmp_path: Path) -> None:
    run = Run(tmp_path / "baseline_seed1", ("experiment=ablation/baseline", "seed=1"), 100.0)
    check_settings(run)  # nothing there yet
    there = to_dict(
        load_train_config(["experiment=ablation/baseline", "seed=1", "minutes=0", "samples=50", "processes=2"])
    )
    checkpoint = run.folder / "checkpoints" / "update_00000001"
    checkpoint.mkdir(parents=True)
    meta = {"format": FORMAT, "config": there, "counters": {"samples": 50}, "weights": {}, "training": None}
    (checkpoint / "checkpoint.json").write_text(json.dumps(meta))
    check_settings(run)  # limits and the number of processes are free
    with pytest.raises(ConfigError, match=r"baseline_seed1 was trained with algo\.gamma 0\.98, and 0\.9 is asked for"):
        check_settings(Run(run.folder, (*run.overrides, "algo.gamma=0.9"), 100.0))
