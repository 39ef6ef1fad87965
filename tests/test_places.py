"""Where the commands run: paths, locales, users, disks and memory that a developer's machine does not have."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from pace.runs.checkpoint import load_checkpoint
from tests.helpers.outside import SMALL

ROOT = Path(__file__).resolve().parent.parent
EVALUATED = ("rows=[mixed]", "serves=4", "num_worlds=4", "warmup_serves=0", "physics_dt=0.01", "engine.threads=1")
#: Another user, who may read everything (this environment belongs to root) and write nothing but his own.
NOBODY = (
    "setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "--inh-caps=-all,+dac_read_search",
    "--ambient-caps=-all,+dac_read_search", "--bounding-set=-all,+dac_read_search",
)  # fmt: skip
pytestmark = pytest.mark.long


def pace(
    folder: Path, *arguments: str, before: Sequence[str] = (), **environment: str
) -> subprocess.CompletedProcess[str]:
    """``pace ARGUMENTS`` in ``folder``, after the words ``before``, in this environment and no other."""
    given = {"PATH": os.environ["PATH"], "HOME": os.environ.get("HOME", "/"), "OMP_NUM_THREADS": "1"}
    given |= {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", **environment}
    line = [*before, sys.executable, "-m", "pace", *arguments]
    return subprocess.run(line, cwd=folder, env=given, capture_output=True, text=True, errors="replace", check=False)


def require_trained(done: subprocess.CompletedProcess[str], run: Path) -> None:
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert load_checkpoint(run).counters["updates"] == 2


@pytest.fixture
def shared() -> Iterator[Path]:
    """A folder that everybody may enter: pytest's own are closed to other users."""
    folder = Path("/tmp") / f"pace_places_{os.getpid()}"
    folder.mkdir()
    folder.chmod(0o777)
    yield folder
    shutil.rmtree(folder)


UTF8 = {"LC_ALL": "C.UTF-8"}
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.parametrize("locale", [UTF8, ASCII, {"LC_ALL": "tr_TR.ISO-8859-9"}], ids=["utf-8", "ascii", "not there"])
def test_a_path_with_spaces_and_letters_of_any_script(tmp_path: Path, locale: dict[str, str]) -> None:
    folder = tmp_path / "mein Ordner, größer = 卓球 $x"
    folder.mkdir()
    require_trained(pace(folder, "train", *SMALL, "processes=2", "out=Läufe/der 1.", **locale), folder / "Läufe/der 1.")
    done = pace(folder, "evaluate", "Läufe/der 1.", *EVALUATED, "out=Maße (½)", **locale)
    assert done.returncode == 0, done.stderr
    assert (folder / "Maße (½)" / "evaluation.json").is_file()


def test_another_user_without_a_home_and_an_installation_that_cannot_be_written(shared: Path) -> None:
    if os.getuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root can be another user")
    done = pace(shared, "train", *SMALL, "out=run", before=NOBODY, HOME="/nonexistent", TMPDIR=str(shared))
    require_trained(done, shared / "run")
    assert {file.stat().st_uid for file in (shared / "run").iterdir()} == {65534}


def test_neither_compiler_nor_git(tmp_path: Path) -> None:
    require_trained(pace(tmp_path, "train", *SMALL, "out=run", PATH="/nonexistent"), tmp_path / "run")


#: Runs what follows where no library of OpenGL can be loaded.
WITHOUT_GL = (
    "unshare", "--mount", "sh", "-c",
    "for file in $(ldconfig -p | sed -n 's/.*=> //p' | grep -E '/lib(EGL|GL|GLES|OSMesa|OpenGL)[^/]*$'); do "
    'mount --bind /dev/null "$(readlink -f "$file")" || exit 99; done; exec "$@"', "sh",
)  # fmt: skip


def test_no_opengl(tmp_path: Path) -> None:
    if os.getuid() != 0 or pace(tmp_path, "--help", before=WITHOUT_GL).returncode != 0:
        pytest.skip("this machine lets no test hide a library")
    require_trained(pace(tmp_path, "train", *SMALL, "out=run", before=WITHOUT_GL), tmp_path / "run")
    done = pace(tmp_path, "evaluate", "run", *EVALUATED, "out=table", before=WITHOUT_GL)
    assert done.returncode == 0, done.stderr
    done = pace(tmp_path, "play", "run", "--video", "film.mp4", "seconds=0.1", before=WITHOUT_GL)
    assert done.returncode == 1
    assert "apt install libegl1" in done.stderr.strip().splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.parametrize("processes", [1, 2])
def test_a_temporary_folder_that_is_full(tmp_path: Path, processes: int) -> None:
    """A group's workers write there what they print; without that a run needs none."""
    full = tmp_path / "full"
    full.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", full], check=False).returncode != 0:
        pytest.skip("this machine lets no test mount")
    try:
        (full / "filling").write_bytes(bytes(os.statvfs(full).f_bavail * os.statvfs(full).f_frsize))
        done = pace(tmp_path, "train", *SMALL, f"processes={processes}", "out=run", TMPDIR=str(full))
        require_trained(done, tmp_path / "run")
    finally:
        subprocess.run(["umount", "-l", full], check=False)


def test_a_disk_that_is_full_for_what_is_printed(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    line = ["sh", "-c", 'exec "$@" > /dev/full', "sh"]
    done = pace(tmp_path, "train", *SMALL, "out=run", before=line)
    assert load_checkpoint(tmp_path / "run").counters["updates"] == 2
    assert "Traceback" not in done.stderr
