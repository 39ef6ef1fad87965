"""Many runs and many machines: Slurm's script with a stand-in for scontrol, launchers of Hydra, two network spaces."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from pace.config.base import config_dir
from pace.runs.checkpoint import load_checkpoint
from tests.helpers.outside import SMALL, python
from tests.helpers.training import assert_same, rows_of

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "examples" / "slurm.sh"
UPDATE = 32  # control steps of an update of SMALL
LIMITS = ("minutes=0", "processes=1")


def environment(**changes: str) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PYTHON": sys.executable} | changes


@pytest.fixture
def slurm(tmp_path: Path) -> dict[str, str]:
    """The environment of a job, with a stand-in for scontrol that notes how it was called."""
    programs = tmp_path / "bin"
    programs.mkdir()
    stand_in = programs / "scontrol"
    stand_in.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/called\n')
    stand_in.chmod(0o755)
    return environment(PATH=f"{programs}:{os.environ['PATH']}", SLURM_JOB_ID="77", SLURM_ARRAY_TASK_ID="3")


def submit(job: dict[str, str], folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """The script as Slurm runs it, in ``folder``."""
    line = ["bash", str(SCRIPT), *arguments]
    pipe = subprocess.PIPE
    return subprocess.Popen(line, cwd=folder, env=job, text=True, stdout=pipe, stderr=pipe)


@pytest.mark.slow
def test_a_preempted_job_is_requeued_and_goes_on_where_it_stopped(slurm: dict[str, str], tmp_path: Path) -> None:
    updates = 150
    small = (*(each for each in SMALL if not each.startswith("samples")), *LIMITS, f"samples={updates * UPDATE}")
    arguments = ("my runs/seed%a", "seed=%a", *small)
    run = tmp_path / "my runs" / "seed3"
    job = submit(slurm, tmp_path, *arguments)
    while job.poll() is None and not (run / "metrics.csv").exists():
        time.sleep(0.02)
    job.send_signal(signal.SIGTERM)
    out, err = job.communicate(timeout=120)
    assert job.returncode == 75, err
    assert "stopped by SIGTERM" in out
    assert (tmp_path / "called").read_text() == "requeue 77\n"
    saved = load_checkpoint(run).counters["updates"]
    assert 0 < saved < updates
    job = submit(slurm, tmp_path, *arguments)  # as Slurm starts it again
    out, err = job.communicate(timeout=120)
    assert job.returncode == 0, err
    assert f"resuming from my runs/seed3/checkpoints/update_{saved:08.0f}" in out
    assert (tmp_path / "called").read_text() == "requeue 77\n"
    assert [row["update"] for row in rows_of(run)] == [str(update) for update in range(1, updates + 1)]


def test_the_script_needs_a_run_folder_and_tells_failures(slurm: dict[str, str], tmp_path: Path) -> None:
    for arguments in ((), ("seed=3",)):
        job = submit(slurm, tmp_path, *arguments)
        assert "usage: sbatch" in job.communicate(timeout=60)[1]
        assert job.returncode == 2
    job = submit(slurm, tmp_path, "runs/mine", "num_world=3")
    assert "did you mean num_worlds?" in job.communicate(timeout=60)[1]
    assert job.returncode == 2
    assert not (tmp_path / "called").exists()


def test_the_launcher_for_slurm_composes() -> None:
    if importlib.util.find_spec("hydra_plugins.hydra_submitit_launcher") is None:
        pytest.skip("needs hydra-submitit-launcher")
    with initialize_config_dir(config_dir=str(config_dir()), version_base="1.3"):
        found = compose("train", ["hydra/launcher=slurm", "hydra.launcher.account=me"], return_hydra_config=True)
    launcher = found.hydra.launcher
    assert launcher["_target_"].endswith("SlurmLauncher")
    assert (launcher.account, launcher.timeout_min, launcher.max_num_timeout) == ("me", 720, 0)


@pytest.mark.long
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_a_launcher_runs_jobs_at_once_and_tells_that_one_failed(tmp_path: Path, launcher: str) -> None:
    plugin = launcher.split("_")[0]
    if importlib.util.find_spec(f"hydra_plugins.hydra_{plugin}_launcher") is None:
        pytest.skip(f"needs hydra-{plugin}-launcher")
    sweep = ("-m", f"hydra/launcher={launcher}", "seed=1,2", "out=seed${seed}", "hydra.sweep.dir=jobs")
    sweep += ("hydra.launcher.n_jobs=2",) if launcher == "joblib" else ("hydra.launcher.timeout_min=5",)
    done = python(tmp_path, "pace.rl.train", *sweep, *SMALL, "processes=2")
    assert done.returncode == 0, done.stderr
    for seed in (1, 2):
        trained = load_checkpoint(tmp_path / f"seed{seed}")
        assert (trained.config["seed"], trained.counters["updates"]) == (seed, 2)
        assert trained.training is not None
        assert len(trained.training["processes"]) == 2
    again = python(tmp_path, "pace.rl.train", *sweep, *SMALL, "processes=2")
    assert again.returncode == 2  # both runs are there already
    if launcher == "joblib":
        assert again.stderr.count("resume=seed") == 2
    assert "Traceback" not in again.stderr


#: Stand-ins for Slurm's programs: a job of an array is a process of this machine.
SBATCH = """#!/bin/bash
cp "${@: -1}" "$HERE/submitted"
for task in $(seq 0 $(sed -n 's/^#SBATCH --array=0-\\([0-9]*\\)%.*/\\1/p' "${@: -1}")); do
  SLURM_JOB_ID=77 SLURM_ARRAY_JOB_ID=77 SLURM_ARRAY_TASK_ID=$task SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_NODEID=0 \\
    SLURM_NTASKS=1 SLURM_JOB_NUM_NODES=1 SLURM_JOB_NODELIST=here bash "${@: -1}" > /dev/null 2>&1 &
done
echo "Submitted batch job 77"
"""
SRUN = """#!/bin/bash
while [[ $1 == -* ]]; do if [[ $1 == --output || $1 == --error ]]; then shift 2; else shift; fi; done
exec "$@"
"""
SACCT = """#!/bin/bash
echo "JobID|State|NodeList"
for task in 0 1; do echo "77_$task|RUNNING|here"; done
"""


@pytest.mark.long
def test_a_sweep_is_an_array_of_slurm_whose_jobs_get_a_signal_before_their_time_ends(tmp_path: Path) -> None:
    if importlib.util.find_spec("hydra_plugins.hydra_submitit_launcher") is None:
        pytest.skip("needs hydra-submitit-launcher")
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, text in (("sbatch", SBATCH), ("srun", SRUN), ("sacct", SACCT)):
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    job = environment(PATH=f"{programs}:{os.environ['PATH']}", HERE=str(tmp_path))
    line = [sys.executable, "-m", "pace.rl.train", "-m", "hydra/launcher=slurm", "hydra.launcher.partition=gpu"]
    line += ["seed=1,2", "out=seed${seed}", "hydra.sweep.dir=jobs", *SMALL, *LIMITS]
    done = subprocess.run(line, cwd=tmp_path, env=job, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert [load_checkpoint(tmp_path / f"seed{seed}").config["seed"] for seed in (1, 2)] == [1, 2]
    asked = (tmp_path / "submitted").read_text()
    for option in ("array=0-1%2", "signal=TERM@180", "time=720", "partition=gpu", "mem=64GB", "cpus-per-task=16"):
        assert f"#SBATCH --{option}\n" in asked, asked
    assert "#SBATCH --gpus-per-node=1\n" in asked


@pytest.fixture
def two_networks() -> Iterator[tuple[str, str]]:
    """Two network name spaces with a cable between them, as two machines have; their names."""
    if os.getuid() != 0:
        pytest.skip("only root can make network name spaces")
    names = (f"pace_a_{os.getpid()}", f"pace_b_{os.getpid()}")
    lines = [f"netns add {name}" for name in names]
    lines.append(f"link add va netns {names[0]} type veth peer name vb netns {names[1]}")
    for name, end, address in zip(names, ("va", "vb"), ("10.77.0.1", "10.77.0.2"), strict=True):
        lines += [f"-n {name} addr add {address}/24 dev {end}", f"-n {name} link set {end} up"]
        lines.append(f"-n {name} link set lo up")
    try:
        for line in lines:
            done = subprocess.run(["ip", *line.split()], capture_output=True, text=True, check=False)
            if done.returncode != 0:
                pytest.skip(f"this machine makes no network name spaces: ip {line}: {done.stderr.strip()}")
        yield names
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)


@pytest.mark.long
def test_two_machines_train_what_two_processes_of_one_do(two_networks: tuple[str, str], tmp_path: Path) -> None:
    """torchrun with gloo, one process on each side."""
    fixed = (*SMALL, "device=cpu", "minutes=0")
    here = python(tmp_path, "pace.rl.train", *fixed, "processes=2", "out=here")
    assert here.returncode == 0, here.stderr
    started = []
    for name, end in zip(two_networks, ("va", "vb"), strict=True):
        line = ["ip", "netns", "exec", name, sys.executable, "-m", "torch.distributed.run", "--nnodes=2"]
        line += ["--nproc-per-node=1", "--rdzv-backend=c10d", "--rdzv-endpoint=10.77.0.1:29400", "--rdzv-id=pace"]
        line += [
            f"--local-addr=10.77.0.{1 + len(started)}",
            f"--rdzv-conf=is_host={int(not started)}",
            "-m",
            "pace.rl.train",
            *fixed,
            "out=there",
        ]
        job = environment(GLOO_SOCKET_IFNAME=end)
        started.append(subprocess.Popen(line, cwd=tmp_path, env=job, stderr=subprocess.PIPE, text=True))
    for process in started:
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
    first, second = load_checkpoint(tmp_path / "here"), load_checkpoint(tmp_path / "there")
    assert first.training is not None
    assert second.training is not None
    assert len(second.training["processes"]) == 2
    assert_same(first.weights, second.weights)
    assert rows_of(tmp_path / "here") == rows_of(tmp_path / "there")
