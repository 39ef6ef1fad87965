"""Warp's folder of kernels for a user without a home: a private one in the temporary folder, or one line."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from subprocess import Popen

import pytest

from pace.arrays.kernel_cache import private_folder, without_line
from pace.config.base import ConfigError
from pace.devices import has_driver

ROOT = Path(__file__).parents[2]
#: Another user, who may read everything (this environment belongs to root) and write nothing.
NOBODY = (
    "setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "--inh-caps=-all,+dac_read_search",
    "--ambient-caps=-all,+dac_read_search", "--bounding-set=-all,+dac_read_search",
)  # fmt: skip
COMPILE = """
import pace.arrays, warp as wp
@wp.kernel
def _double(values: wp.array[wp.float32]):
    values[wp.tid()] = 2.0 * values[wp.tid()]
values = wp.full(2, 3.0, dtype=wp.float32, device="cpu")
wp.launch(_double, 2, [values], device="cpu")
print(values.numpy().tolist(), wp.config.kernel_cache_dir)
"""
#: Waits until both jobs have come this far.
BARRIER = """
import pathlib, sys, time
pathlib.Path(f"here_{sys.argv[1]}").touch()
while len(list(pathlib.Path(".").glob("here_*"))) < 2:
    time.sleep(0.001)
"""


def test_a_folder_is_this_users_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    folder = private_folder("why")
    assert folder.parent == tmp_path
    assert folder.stat().st_mode & 0o777 == 0o700
    assert private_folder("why") == folder
    folder.chmod(0o777)  # kernels in it could be anybody's
    with pytest.raises(ConfigError, match=r"why; WARP_CACHE_PATH names another folder .*not this user's alone"):
        private_folder("why")
    folder.rmdir()
    folder.symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="not this user's alone"):
        private_folder("why")


def test_a_line_of_native_code_is_left_out_and_others_stay(capfd: pytest.CaptureFixture[str]) -> None:
    with without_line(b"no driver"):
        os.write(2, b"one\nWarning: no driver here\ntwo\n")
        assert capfd.readouterr().err == ""
    assert capfd.readouterr().err == "one\ntwo\n"

    def fail() -> None:
        with without_line(b"no driver"):
            os.write(2, b"no driver\nwhy\n")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    os.write(2, b"no driver\n")  # again as before
    assert capfd.readouterr().err == "why\nno driver\n"


def test_a_machine_without_a_gpu_is_told_nothing_of_drivers() -> None:
    if has_driver():
        pytest.skip("a GPU's driver is here")
    done = subprocess.run([sys.executable, "-c", "import pace.sim.worlds"], capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def as_nobody(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    if os.getuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root can be another user")
    given = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"} | environment
    line = [*NOBODY, sys.executable, "kernel.py"]
    (folder / "kernel.py").write_text(COMPILE)
    return subprocess.run(line, cwd=folder, env=given, capture_output=True, text=True, check=False)


def test_a_user_without_a_home_compiles_kernels_in_the_temporary_folder(tmp_path: Path) -> None:
    shared = Path("/tmp") / f"pace_test_{os.getpid()}"  # pytest's own folders are closed to others
    shared.mkdir()
    shared.chmod(0o777)
    try:
        done = as_nobody(tmp_path, HOME="/nonexistent", TMPDIR=str(shared))
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith(f"[6.0, 6.0] {shared}/pace_kernels_65534")
        assert "WARP_CACHE_PATH names no other folder" in done.stderr
        done = as_nobody(tmp_path, HOME="/nonexistent", WARP_CACHE_PATH=str(shared / "own"))
        assert done.stdout.startswith(f"[6.0, 6.0] {shared}/own"), done.stderr
    finally:
        shutil.rmtree(shared)


def test_a_named_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    done = as_nobody(tmp_path, HOME="/nonexistent", WARP_CACHE_PATH="/proc/kernels")
    assert done.returncode == 1
    assert "WARP_CACHE_PATH: /proc/kernels cannot be made" in done.stderr.splitlines()[-1]


def test_jobs_that_compile_into_one_folder_at_once(tmp_path: Path) -> None:
    """As in an array of jobs on a cluster, whose home is shared."""
    (tmp_path / "kernel.py").write_text(COMPILE.replace("values = ", BARRIER + "values = ", 1))
    given = os.environ | {"PYTHONPATH": str(ROOT), "WARP_CACHE_PATH": str(tmp_path / "kernels")}
    jobs = [
        Popen([sys.executable, "kernel.py", str(k)], cwd=tmp_path, env=given, text=True, stdout=-1, stderr=-1)
        for k in range(2)
    ]
    for job in jobs:
        out, error = job.communicate()
        assert out.startswith("[6.0, 6.0]"), error
    left = [file.name for file in (tmp_path / "kernels").rglob("*") if "_p" in file.name and file.is_dir()]
    assert left == []  # folders in which a job was still building
