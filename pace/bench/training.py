"""The whole training loop, run by its command: control steps a second and peak memory."""

from __future__ import annotations

import csv
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from pace.config.commands import BenchConfig
from pace.config.training import load_train_config
from pace.runs.run_folder import METRICS

POLL_SECONDS = 0.1  # of the memory's high-water mark, which never falls while a process runs
SELDOM = 12  # control steps an update, of a recipe with fewer updates than the default
WARM_UP_ROWS = 2  # excluded updates: compilation, allocation
PAPER_NETWORKS = {"algo": "paper", "observation": "paper"}  # default physics and task, the paper's networks and critic


class BenchError(RuntimeError):
    """A measured command failed; the message holds the end of its output."""


def without(overrides: list[str], *keys: str) -> list[str]:
    """The Hydra overrides that set none of ``keys``."""
    return [override for override in overrides if override.lstrip("+~").split("=")[0] not in keys]


def train_rates(config: BenchConfig, overrides: list[str]) -> dict[str, float]:
    """Training with the default recipe, with fewer updates and with the paper's networks; peak memory of the first."""
    updates = config.bench.train_updates
    rate, memory = training_run(config.num_worlds, updates, overrides)
    seldom = [*without(overrides, "algo.steps"), f"algo.steps={SELDOM}"]
    seldom_rate, _ = training_run(config.num_worlds, updates, seldom)
    paper = [*without(overrides, *PAPER_NETWORKS), *(f"{key}={value}" for key, value in PAPER_NETWORKS.items())]
    paper_rate, _ = training_run(config.num_worlds, updates, paper)
    return {
        "train_steps_per_s": rate,
        "train_12_steps_per_s": seldom_rate,
        "train_paper_steps_per_s": paper_rate,
        "peak_memory_mib": memory,
    }


def memory_peak(config: BenchConfig, overrides: list[str]) -> dict[str, float]:
    """Peak memory with four times the worlds."""
    _, memory = training_run(4 * config.num_worlds, config.bench.memory_updates, overrides)
    return {"peak_memory_4x_mib": memory}


def training_run(
    num_worlds: int, updates: int, overrides: list[str], prefix: Sequence[str] = ()
) -> tuple[float, float]:
    """Train for ``updates`` in a separate command, which a program may begin: ``prefix``, such as ``nice``.

    Returns its control steps a second after the first updates (NaN for a run that is too short), and the largest
    resident memory of its processes together in MiB. Errors: :class:`BenchError` when the command fails.
    """
    kept = without(overrides, "num_worlds", "samples", "minutes", "out", "progress", "tensorboard", "logger")
    steps = load_train_config(kept).algo.steps
    with tempfile.TemporaryDirectory() as folder:
        settings = {
            "num_worlds": num_worlds,
            "algo.steps": steps,
            "samples": updates * num_worlds * steps,
            "minutes": 0,
            "progress": "false",
            "tensorboard": "false",
            "out": folder,
        }
        command = [*prefix, sys.executable, "-m", "pace.rl.train", *kept, *(f"{k}={v}" for k, v in settings.items())]
        memory = _peak_mib(command, Path(folder) / "output.txt")
        return steady_rate(Path(folder) / METRICS), memory


def _peak_mib(command: list[str], output: Path) -> float:
    peak = 0.0
    with output.open("w", encoding="utf-8") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        while process.poll() is None:
            peak = max(peak, sum(_resident_peak_mib(pid) for pid in _family(process.pid)))
            time.sleep(POLL_SECONDS)
    if process.returncode != 0:
        tail = "\n".join(output.read_text(encoding="utf-8").splitlines()[-15:])
        raise BenchError(f"{' '.join(command)} ended with status {process.returncode}:\n{tail}")
    return peak


def _family(pid: int) -> list[int]:
    """A process and those that it started, such as the workers of a training run."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8").split()
    except FileNotFoundError:  # it has just ended, or there is no /proc, which the caller reports
        children = []
    return [pid, *(descendant for child in children for descendant in _family(int(child)))]


def _resident_peak_mib(pid: int) -> float:
    """High-water mark of a running process; 0 if it has just ended.

    Linux counts the parent's own peak into a child's ``ru_maxrss`` (it is kept over exec), so that cannot be used.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        if not Path("/proc/self/status").exists():
            raise BenchError("peak memory is read from /proc: leave train and memory out of bench.parts") from None
        return 0.0
    return max((float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), default=0.0)


def steady_rate(metrics: Path) -> float:
    """Control steps a second in a run's metrics after its first updates; NaN if there are no more."""
    with metrics.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    if len(rows) <= WARM_UP_ROWS:
        return float("nan")
    first, last = rows[WARM_UP_ROWS - 1], rows[-1]
    return (float(last["samples"]) - float(first["samples"])) / (float(last["wall_s"]) - float(first["wall_s"]))
