"""Long runs: memory and open files as they are measured, and an account in which every serve has a place."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from pace.config.base import ConfigError
from pace.evaluation.records import COLUMNS, C
from pace.rl.policies import load_policy
from pace.studies import memory, soak, watch
from pace.task.game import Outcome

pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")


def test_memory_and_open_files_are_those_of_the_process(tmp_path: Path) -> None:
    pid = os.getpid()
    before, files = watch.resident(pid), watch.open_files(pid)
    block = np.ones(2**25, dtype=np.uint8)  # 32 MiB, touched
    with (tmp_path / "a").open("w"), (tmp_path / "b").open("w"):
        assert watch.open_files(pid) == files + 2
    assert watch.resident(pid) - before == pytest.approx(32.0, abs=8.0)
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "c").write_bytes(bytes(3 * 2**20))
    assert watch.folder_size(tmp_path) == pytest.approx(3.0)
    assert block.sum() == 2**25


def test_growth_is_that_after_the_start() -> None:
    progress = np.arange(1.0, 101.0)
    memory_used = np.where(progress < 10, 50.0 * progress, 500.0 + 0.2 * progress)
    grown, most = watch.growth(progress, memory_used)
    assert grown == pytest.approx(0.2 * 90)
    assert most == pytest.approx(0.2 * 90)
    assert watch.growth(progress, np.full(100, 7.0)) == pytest.approx((0.0, 0.0), abs=1e-9)


def finished(balls: list[list[int]], bad: list[int], played: list[int]) -> Any:
    """A recorder whose worlds have records of these balls, all of them misses but for the first."""
    records = torch.zeros(len(balls) * len(balls[0]) + 1, len(COLUMNS))
    records[:-1, C["ball"]] = torch.tensor(balls).float().flatten()
    records[:, C["outcome"]] = Outcome.MISS
    records[0, C["outcome"]] = Outcome.SUCCESS
    clock = SimpleNamespace(played=torch.tensor(played).float())
    env = SimpleNamespace(num_worlds=len(balls), game=SimpleNamespace(clock=clock))
    return SimpleNamespace(
        env=env, quota=len(balls[0]), records=records, bad=torch.tensor(bad), played=torch.tensor(played)
    )


def test_every_serve_has_a_place() -> None:
    recorder = finished([[3, 4, 5], [3, 5, 6]], bad=[0, 1], played=[8, 6])
    found = soak.account(recorder, warmup=2)
    assert (found.played, found.first, found.bad, found.counted, found.beyond) == (14, 4, 1, 6, 3)
    assert found.played == found.first + found.bad + found.counted + found.beyond
    assert (found.success, found.failures["miss"], found.missing) == (1, 5, 0)
    assert "0 missing" in soak.text(found)


@pytest.mark.parametrize("fault", ["lost", "counted twice", "undecided"])
def test_a_serve_without_a_place_is_found(fault: str) -> None:
    recorder = finished([[3, 4, 5], [3, 5, 6]], bad=[0, 1], played=[8, 6])
    if fault == "lost":
        recorder.bad[1] = 0
    elif fault == "counted twice":
        recorder.played = recorder.played + torch.tensor([0, 1])
    else:
        recorder.records[4, C["outcome"]] = torch.nan
    assert soak.account(recorder, warmup=2).missing == 1


@pytest.mark.slow
def test_a_training_run_is_watched(tmp_path: Path) -> None:
    watched = memory.watch_training(tmp_path, 40, 8, interval=0.01)
    progress, seconds, used, files, size = watched.columns()
    assert 0 < progress[-1] <= 40
    assert np.all(np.diff(seconds) > 0)
    assert np.all(used > 100)
    assert np.all(files < 64)
    assert size[-1] > 0.0
    assert (tmp_path / "run" / "learning_curve.png").exists()
    with pytest.raises(ConfigError, match=r"status 2: .*has a checkpoint of update 40"):
        memory.watch_training(tmp_path, 40, 8)


@pytest.mark.long
def test_a_long_evaluation_loses_no_serve_and_does_not_grow() -> None:
    found, watched = soak.soak(load_policy("pretrained/campaign"), 4000, 128)
    assert found.missing == 0
    assert found.counted == 4096
    assert found.success > 3000
    progress, _, used, files, _ = watched.columns()
    grown, _ = watch.growth(progress, used)
    assert grown < 5.0  # MiB
    assert np.ptp(files[progress > 400]) <= 1


@pytest.mark.slow
def test_a_page_is_watched_while_a_browser_looks() -> None:
    pytest.importorskip("mjviser")
    from pace.studies.page_soak import watch_page

    watched, sent = watch_page(load_policy("pretrained/pace"), 10.0 / 3600.0, interval=0.05)
    progress, _, used, files, _ = watched.columns()
    assert progress[-1] == pytest.approx(10.0, abs=1.0)
    assert sent > 10_000
    assert np.all(used > 100)
    assert np.ptp(files[len(files) // 2 :]) <= 2
