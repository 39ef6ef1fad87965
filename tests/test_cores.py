"""Cores that may be used: the CPU set, and the quota of control groups of both versions."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pace import cores
from pace.cores import core_set, quota, threads_of, usable_cores
from pace.runs.queue import shares_of_cores
from tests.helpers.control_groups import control_group

V1 = "36 25 0:31 {root} {mount} rw,nosuid - cgroup cgroup rw,cpu,cpuacct\n"
V2 = "29 23 0:26 {root} {mount} rw,nosuid - cgroup2 cgroup2 rw\n"


def process(folder: Path, mounts: str, groups: str) -> Path:
    """A process as /proc shows it."""
    folder.mkdir()
    (folder / "mountinfo").write_text("22 1 8:1 / / rw - ext4 /dev/vda rw\n" + mounts)
    (folder / "cgroup").write_text(groups)
    return folder


def write(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text + "\n")


def test_the_tightest_group_of_version_2_counts(tmp_path: Path) -> None:
    mount = tmp_path / "a mount"
    write(mount / "cpu.max", "max 100000")
    write(mount / "slurm" / "cpu.max", "250000 100000")
    write(mount / "slurm" / "job" / "cpu.max", "800000 100000")
    mounts = V2.format(root="/", mount=str(mount).replace(" ", "\\040"))
    assert quota(process(tmp_path / "job", mounts, "0::/slurm/job\n")) == 2.5
    assert quota(process(tmp_path / "other", mounts, "0::/free\n")) is None
    assert quota(process(tmp_path / "beyond", mounts, "0::/../elsewhere\n")) is None  # as a namespace shows it


def test_a_container_of_version_1_has_its_own_group_at_the_mount(tmp_path: Path) -> None:
    mount = tmp_path / "cpu"
    write(mount / "cpu.cfs_quota_us", "150000")
    write(mount / "cpu.cfs_period_us", "100000")
    mounts = V1.format(root="/docker/abc", mount=mount) + V2.format(root="/", mount=tmp_path / "unified")
    assert quota(process(tmp_path / "in", mounts, "4:memory:/docker/abc\n3:cpu,cpuacct:/docker/abc\n0::/x\n")) == 1.5
    write(mount / "cpu.cfs_quota_us", "-1")
    assert quota(process(tmp_path / "free", mounts, "3:cpu,cpuacct:/docker/abc\n")) is None


def test_without_proc_nothing_is_known(tmp_path: Path) -> None:
    assert quota(tmp_path / "nothing") is None
    assert quota(process(tmp_path / "odd", "nonsense\n - cgroup2\n", "")) is None


@pytest.mark.parametrize(("granted", "usable"), [(None, 8), (3.5, 3), (0.2, 1), (64.0, 8)])
def test_threads_follow_the_quota(monkeypatch: pytest.MonkeyPatch, granted: float | None, usable: int) -> None:
    monkeypatch.setattr(cores, "core_set", lambda: list(range(8)))
    monkeypatch.setattr(cores, "quota", lambda: granted)
    assert usable_cores() == usable
    assert threads_of(2) == max(1, usable // 2)


def test_a_queue_shares_as_many_cores_as_are_granted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pace.runs.queue.core_set", lambda: list(range(8)))
    monkeypatch.setattr("pace.runs.queue.usable_cores", lambda: 4)
    monkeypatch.setattr(os, "getpid", lambda: 8 * 1000 + 6)
    first, second = shares_of_cores(2)
    assert sorted(first + second) == [0, 1, 6, 7]


#: One core, or the time of one: version, controller, and what is written into the group.
LIMITED = {
    "quota of version 1": (1, "cpu", {"cpu.cfs_period_us": "100000", "cpu.cfs_quota_us": "100000"}),
    "quota of version 2": (2, "cpu", {"cpu.max": "100000 100000"}),
    "cpuset of version 1": (1, "cpuset", {"cpuset.mems": "0", "cpuset.cpus": str(max(core_set(), default=0))}),
    "cpuset of version 2": (2, "cpuset", {"cpuset.cpus": str(max(core_set(), default=0))}),
}


@pytest.fixture
def one_core(request: pytest.FixtureRequest) -> Iterator[Path]:
    """A control group of this machine: with the time of one core, or with one core."""
    with control_group(*LIMITED[request.param]) as group:
        yield group


@pytest.mark.skipif(len(core_set()) < 2, reason="needs two cores")
@pytest.mark.parametrize("one_core", LIMITED, indirect=True)
def test_a_process_in_a_group_with_one_core_sees_it_before_torch_is_loaded(one_core: Path) -> None:
    code = (
        "import sys; from pace.command.run import _limit_threads; _limit_threads(); assert 'torch' not in sys.modules;"
        "import torch; from pace.distributed import suitable_size; from pace.cores import usable_cores;"
        "print(usable_cores(), torch.get_num_threads(), suitable_size(1024, torch.device('cpu')))"
    )
    enter = f'echo $$ > {one_core}/cgroup.procs; exec {sys.executable} -c "{code}"'
    environment = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
    done = subprocess.run(["sh", "-c", enter], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["1", "1", "1"], done.stderr
