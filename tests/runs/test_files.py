"""Files of a run on disks that fill up, on folders that are deleted, and after kills."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pace.bench import report as bench
from pace.evaluation.report import write_serves
from pace.runs.files import AppendFile, write_figure, write_whole
from pace.runs.metrics import read_metrics, write_slim
from pace.runs.metrics_file import EventsFile, MetricsFile, read_rows
from pace.runs.run_folder import RunFolder


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 KiB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", disk], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip("this machine lets no test mount")
    yield disk
    subprocess.run(["umount", "-l", disk], check=True)


def fill(disk: Path) -> Path:
    """A file that takes all the space that is left."""
    left = os.statvfs(disk)
    (disk / "filling").write_bytes(bytes(left.f_bavail * left.f_frsize))
    return disk / "filling"


def test_what_does_not_fit_waits_until_there_is_space(small_disk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = AppendFile(small_disk / "log", lambda: b"head\n")
    file.add(b"first\n")
    filling = fill(small_disk)
    for number in range(3):
        file.add(f"{number}\n".encode() * 4000)
    assert (small_disk / "log").read_text() == "head\nfirst\n"  # nothing of a piece that does not fit
    filling.unlink()
    file.add(b"last\n")
    assert (small_disk / "log").read_text() == "head\nfirst\n" + "".join(f"{n}\n" * 4000 for n in range(3)) + "last\n"
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2
    assert "cannot be written: No space left on device" in said[0]
    assert said[1].endswith("can be written again; nothing of it is lost")


def test_a_full_disk_leaves_what_was_there(small_disk: Path) -> None:
    (small_disk / "config.yaml").write_text("what was there\n")
    fill(small_disk)
    with pytest.raises(OSError, match="No space left"):
        write_whole(small_disk / "config.yaml", "new\n" * 10_000)
    assert (small_disk / "config.yaml").read_text() == "what was there\n"
    assert {file.name for file in small_disk.iterdir()} == {"config.yaml", "filling"}


def test_a_limit_on_the_size_of_files_is_told_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    assert signal.getsignal(signal.SIGXFSZ) == signal.SIG_IGN  # of Python: an error instead of the end
    file = AppendFile(tmp_path / "log")
    file.add(b"a" * 100)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        file.add(b"b" * 4000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (tmp_path / "log").read_bytes() == b"a" * 100
    file.add(b"c")
    assert (tmp_path / "log").read_bytes() == b"a" * 100 + b"b" * 4000 + b"c"
    assert "File too large" in capsys.readouterr().err


def deleted(file: Path) -> None:
    file.unlink()


def replaced(file: Path) -> None:
    file.rename(file.with_suffix(".old"))
    file.write_text("head\nof an editor\n")


@pytest.mark.parametrize(("change", "text"), [(deleted, "head\nsecond\n"), (replaced, "head\nof an editor\nsecond\n")])
def test_a_file_that_is_deleted_or_replaced_goes_on(change: Callable[[Path], None], text: str, tmp_path: Path) -> None:
    file = AppendFile(tmp_path / "run" / "log", lambda: b"head\n")
    file.add(b"first\n")
    change(tmp_path / "run" / "log")
    file.add(b"second\n")
    assert (tmp_path / "run" / "log").read_text() == text
    file.close()


def row(update: int, **more: float) -> dict[str, float]:
    return {"update": update, "samples": 100 * update, "hit_rate": 0.25, "kl": float("nan"), **more}


def write_metrics(file: Path, updates: int = 3) -> MetricsFile:
    metrics = MetricsFile(file, 0)
    for update in range(1, updates + 1):
        metrics.add(row(update, own=0.5))
    return metrics


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text.replace("2,200,", "2,200,", 1).replace("\n3,", ",7,8,9\n3,", 1),  # cells beyond the columns
        lambda text: text + "4,40",  # cut in the middle of a row
        lambda text: text + "\0" * 4096,  # what some file systems leave after a loss of power
        lambda text: text.replace("\n3,", "\nsome words\n3,"),
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text + "\udcff\n",
    ],
)
def test_rows_of_a_damaged_file_are_kept_up_to_the_checkpoint(damage: Callable[[str], str], tmp_path: Path) -> None:
    file = tmp_path / "metrics.csv"
    write_metrics(file)
    good = file.read_text()
    file.write_bytes(damage(good).encode(errors="surrogateescape"))
    metrics = MetricsFile(file, 2)
    assert metrics.samples == 200
    assert file.read_text() == good[: good.index("\n3,") + 1]
    metrics.add(row(3, own=0.5, new=1.0))
    assert file.read_text() == good
    assert read_metrics(file)["own"] == [0.5] * 3


def test_a_file_that_cannot_be_replaced_is_not_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "metrics.csv"
    write_metrics(file)
    before = file.read_text()

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        MetricsFile(file, 1)
    assert file.read_text() == before


def write_serves_of_nobody(file: Path) -> None:
    write_serves(file, [])


def write_slim_of_one_row(file: Path) -> None:
    (file.parent / "metrics.csv").write_text("update,samples\n1,96\n")
    write_slim(file.parent / "metrics.csv", file)


def write_bench(file: Path) -> None:
    bench.write(file, {}, {})


def write_empty_figure(file: Path) -> None:
    write_figure(file, Figure(), dpi=10)


@pytest.mark.parametrize("write", [write_serves_of_nobody, write_slim_of_one_row, write_bench, write_empty_figure])
def test_results_are_written_whole_or_not_at_all(
    write: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "result"
    file.write_text("an hour's work")

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            write(file)
    assert file.read_text() == "an hour's work"
    assert not list(tmp_path.glob(".*"))
    write(file)
    assert file.read_bytes() != b"an hour's work"


def test_no_other_code_writes_a_figure() -> None:
    found = [path for path in Path("pace").rglob("*.py") if ".savefig(" in path.read_text(encoding="utf-8")]
    assert found == [Path("pace/runs/files.py")]


def test_rows_of_text_that_is_no_metrics() -> None:
    assert read_rows("") == ([], [])
    assert read_rows("day,weight\n1,70\n") == ([], [])
    assert read_rows("update,samples\n1,10\n2\nx,1\n") == (["update", "samples"], [{"update": "1", "samples": "10"}])


def scalars(folder: Path, name: str) -> list[tuple[int, float]]:
    reader = EventAccumulator(str(folder))
    reader.Reload()
    return [(event.step, round(event.value, 6)) for event in reader.Scalars(name)]


def test_events_after_a_crash_replace_those_of_the_lost_updates(tmp_path: Path) -> None:
    crashed = RunFolder(tmp_path, {}, tensorboard=True)
    for update in (1, 2, 3, 4):
        crashed.log(row(update, own=update))
    crashed.close()  # as the system does
    resumed = RunFolder(tmp_path, {}, tensorboard=True, first_update=2)
    for update in (3, 4, 5):
        resumed.log(row(update, own=10 * update))
    resumed.close()
    assert scalars(tmp_path / "events", "own") == [(100, 1), (200, 2), (300, 30), (400, 40), (500, 50)]
    assert "kl" not in EventAccumulator(str(tmp_path / "events")).Reload().Tags()["scalars"]  # NaN is left out
    assert read_metrics(tmp_path / "metrics.csv")["own"] == [1, 2, 30, 40, 50]


def test_events_are_those_of_torch(tmp_path: Path) -> None:
    from torch.utils.tensorboard import SummaryWriter

    own, other = EventsFile(tmp_path / "own", 0), SummaryWriter(str(tmp_path / "other"))
    for update in (1, 2):
        own.add(row(update))
        for name, value in row(update).items():
            if value == value:
                other.add_scalar(name, value, 100 * update)
    own.close()
    other.close()
    for name in ("update", "samples", "hit_rate"):
        assert scalars(tmp_path / "own", name) == scalars(tmp_path / "other", name)


def test_a_folder_that_is_deleted_under_the_run_is_made_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = RunFolder(tmp_path / "run", {"name": "mine"}, tensorboard=True)
    folder.log(row(1))
    subprocess.run(["rm", "-r", tmp_path / "run"], check=True)
    folder.log(row(2))
    folder.close()
    assert read_metrics(tmp_path / "run" / "metrics.csv")["update"] == [2]
    assert "name: mine" in (tmp_path / "run" / "config.yaml").read_text()
    assert "was deleted: the run makes it again and goes on" in capsys.readouterr().err


def test_a_file_system_without_locks_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def none(handle: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", none)
    folder = RunFolder(tmp_path, {}, tensorboard=False)
    folder.log(row(1))
    folder.close()
    assert "cannot be locked (No locks available)" in capsys.readouterr().err


def test_a_full_log_does_not_end_the_run(tmp_path: Path) -> None:
    code = "from pace.runs.files import say\nfor _ in range(9): say('x' * 9000)\nopen('done', 'w').close()"
    with Path("/dev/full").open("w") as full:
        subprocess.run([sys.executable, "-c", code], cwd=tmp_path, stderr=full, check=False,
                       env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])})  # fmt: skip
    assert (tmp_path / "done").exists()
