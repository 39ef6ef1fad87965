"""Memory that may be taken: of the machine and of control groups of both versions, and the worlds that fit into it."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from pace.config.automatic import memory_needed, require_memory
from pace.config.base import ConfigError
from pace.distributed import suitable_size
from pace.memory import GIB, available_memory
from pace.runs.checkpoint import load_checkpoint
from tests.helpers.control_groups import control_group
from tests.helpers.outside import SMALL

ROOT = Path(__file__).resolve().parent.parent
V1 = "36 25 0:31 {root} {mount} rw,nosuid - cgroup cgroup rw,memory\n"
V2 = "29 23 0:26 {root} {mount} rw,nosuid - cgroup2 cgroup2 rw\n"


def process(folder: Path, mounts: str, groups: str) -> Path:
    """A process as /proc shows it."""
    folder.mkdir()
    (folder / "mountinfo").write_text("22 1 8:1 / / rw - ext4 /dev/vda rw\n" + mounts)
    (folder / "cgroup").write_text(groups)
    return folder


def group(folder: Path, limit_file: str, limit: str, held: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / limit_file).write_text(limit + "\n")
    (folder / "memory.stat").write_text(f"cache 99\n{held}\n")


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """8 GiB that are available."""
    file = tmp_path / "meminfo"
    file.write_text("MemTotal: 16777216 kB\nMemFree: 1 kB\nMemAvailable: 8388608 kB\n")
    return file


def test_the_least_of_machine_and_groups_is_left(tmp_path: Path, machine: Path) -> None:
    mount = tmp_path / "mount"
    group(mount, "memory.max", "max", "anon 5")
    group(mount / "slurm", "memory.max", str(4 * GIB), f"anon {GIB}")
    group(mount / "slurm" / "job", "memory.max", str(6 * GIB), f"anon {GIB}")
    mounts = V2.format(root="/", mount=mount)
    assert available_memory(process(tmp_path / "job", mounts, "0::/slurm/job\n"), machine) == pytest.approx(3.0)
    assert available_memory(process(tmp_path / "free", mounts, "0::/\n"), machine) == pytest.approx(8.0)


def test_groups_of_version_1(tmp_path: Path, machine: Path) -> None:
    mount = tmp_path / "memory"
    mounts, own = V1.format(root="/docker/a", mount=mount), "4:memory:/docker/a\n3:cpu:/docker/a\n"
    group(mount, "memory.limit_in_bytes", str(2 * GIB), f"total_rss {GIB // 2}")
    assert available_memory(process(tmp_path / "in", mounts, own), machine) == pytest.approx(1.5)
    group(mount, "memory.limit_in_bytes", "9223372036854771712", "total_rss 5")  # what stands for none
    assert available_memory(process(tmp_path / "out", mounts, own), machine) == pytest.approx(8.0)


def test_where_nothing_is_told_there_is_no_limit(tmp_path: Path) -> None:
    assert available_memory(tmp_path, tmp_path / "nothing") == math.inf


def test_what_does_not_fit_is_told_with_what_does() -> None:
    require_memory(1024, 1, 2.0)
    require_memory(10**6, 64, math.inf)
    for worlds, processes in ((65536, 1), (65536, 2), (100_000, 3)):
        with pytest.raises(ConfigError, match=r"GiB of memory, and 2.0 are left: num_worlds=\d+ fits") as found:
            require_memory(worlds, processes, 2.0)
        fitting = int(str(found.value).rpartition("=")[2].split()[0])
        assert fitting % processes == 0
        assert 0.7 * 2.0 < memory_needed(fitting, processes) <= 0.8 * 2.0
    with pytest.raises(ConfigError, match="give fewer processes="):
        require_memory(4096, 8, 2.0)
    with pytest.raises(ConfigError, match="free some"):
        require_memory(8, 1, 0.3)


def test_no_more_processes_than_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pace.distributed.usable_cores", lambda: 16)
    monkeypatch.setattr("pace.distributed.available_memory", lambda: 2.0)
    assert suitable_size(4096, torch.device("cpu")) == 2
    monkeypatch.setattr("pace.distributed.available_memory", lambda: 64.0)
    assert suitable_size(4096, torch.device("cpu")) == 16


@pytest.fixture(params=[(1, "memory.limit_in_bytes"), (2, "memory.max")], ids=["version 1", "version 2"])
def two_gib(request: pytest.FixtureRequest) -> Iterator[Path]:
    """A control group of this machine with 2 GiB."""
    version, limit = request.param
    with control_group(version, "memory", {limit: str(2 * GIB)}) as folder:
        yield folder


@pytest.mark.long
def test_a_run_in_2_gib_says_what_fits_and_fits(two_gib: Path, tmp_path: Path) -> None:
    def train(*arguments: str) -> subprocess.CompletedProcess[str]:
        program = [sys.executable, "-m", "pace.rl.train", *arguments]
        line = ["sh", "-c", f'echo $$ > {two_gib}/cgroup.procs; exec "$@"', "sh", *program]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        return subprocess.run(line, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)

    two_updates = ("minutes=0", "processes=1", "progress=false")
    done = train("num_worlds=65536", *two_updates, "out=large")
    assert done.returncode == 2
    told = done.stderr.strip().splitlines()[-1]
    assert "65536 worlds need about 7.0 GiB of memory" in told
    fitting = int(told.rpartition("num_worlds=")[2].split()[0])
    assert not (tmp_path / "large").exists()
    worlds = fitting // 8 * 8
    done = train(f"num_worlds={worlds}", f"samples={8 * worlds}", *two_updates, "out=fitting")
    assert done.returncode == 0, done.stderr
    assert load_checkpoint(tmp_path / "fitting").counters["updates"] == 2
    assert train(*SMALL, "processes=2", "out=small").returncode == 0
