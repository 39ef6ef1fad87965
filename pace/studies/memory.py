"""Memory, open files and run folder of a long training run, watched from outside of its process."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from pace.config.base import ConfigError
from pace.runs.metrics_file import FIRST_COLUMN
from pace.runs.run_folder import METRICS
from pace.studies.watch import Watch, require_proc

UPDATES, WORLDS = 2000, 1024
#: A learner whose updates are quick, with all files that a run writes; the simulation is that of a training run.
QUICK = (
    "processes=1", "device=cpu", "engine=native", "engine.threads=1", "engine.physics_dt=0.02", "minutes=0",
    "algo.actor_hidden=[32]", "algo.critic_hidden=[32]", "algo.epochs=1", "predictor.batches_per_update=1",
    "checkpoint_minutes=0.1", "tensorboard=true", "progress=false",
)  # fmt: skip
STEPS = 2  # control steps of an update
TAIL = 4096  # bytes of metrics.csv: more than a row
LOOK = 0.25  # s between two looks


def watch_training(
    folder: Path, updates: int = UPDATES, worlds: int = WORLDS, changes: Sequence[str] = (), interval: float = 1.0
) -> Watch:
    """Train ``updates`` updates in ``worlds`` worlds, in the new folder ``folder``/run, and watch the process.

    Errors: :class:`ConfigError` where there is no /proc, and with what the run said, if it failed.
    """
    require_proc()
    run, limits = folder / "run", (f"samples={updates * worlds * STEPS}", f"num_worlds={worlds}", f"algo.steps={STEPS}")
    line = [sys.executable, "-m", "pace.rl.train", *QUICK, *limits, *changes, f"out='{run}'"]
    with (folder / "run.log").open("w+", encoding="utf-8") as log:
        process = subprocess.Popen(
            line, env=os.environ | {"OMP_NUM_THREADS": "1"}, stdout=log, stderr=subprocess.STDOUT
        )
        watch = Watch(process.pid, run, interval)
        try:
            while process.poll() is None:
                _look(watch, run)
                time.sleep(LOOK)
        finally:
            process.kill()
            process.wait()
        if process.returncode != 0:
            log.seek(0)
            raise ConfigError(f"the run ended with status {process.returncode}: {' '.join(log.read().split())[-500:]}")
    return watch


def _look(watch: Watch, run: Path) -> None:
    try:
        watch.sample(last_update(run / METRICS))
    except OSError:  # it has just ended
        return


def last_update(metrics: Path) -> float:
    """The update of the last whole row of a ``metrics.csv``; 0 without one."""
    if not metrics.exists():
        return 0.0
    with metrics.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
        rows = file.read().decode().splitlines()
    cell = rows[-1].split(",")[0] if rows else FIRST_COLUMN
    return float(cell) if cell.isdigit() else 0.0
