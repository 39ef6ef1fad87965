"""Training runs one after another or several at once: each a separate process, on its share of the cores.

The progress of a run is read from its folder, so an interrupted queue resumes where it stopped.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO

from tqdm import tqdm

from pace.command import quote
from pace.config.automatic import left_open
from pace.config.base import ConfigError, compose, parse, search_override, to_dict
from pace.config.training import RESUME_KEYS, TrainConfig, load_train_config
from pace.cores import core_set, usable_cores
from pace.runs.checkpoint import read_meta
from pace.runs.checkpoint_folders import list_checkpoints
from pace.runs.interrupt import StopRequest
from pace.runs.metrics_file import LEADING
from pace.runs.progress import SECONDS_PER_LINE, clock
from pace.runs.run_folder import METRICS

TRAIN = (sys.executable, "-m", "pace.rl.train")
POLL_SECONDS = 0.5
TAIL_BYTES = 8192  # of a metrics.csv: more than its last row
#: Keys that may differ between an existing run and the requested one.
FREE_KEYS = (*RESUME_KEYS, "init_from", "predictor_from", "out")


@dataclass(frozen=True)
class Run:
    """A training run: its folder, the overrides of a new one, its number of control steps, and the modules from outside
    of pace that the user has named for it."""

    folder: Path
    overrides: tuple[str, ...]
    samples: float
    plugins: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.name

    @property
    def log(self) -> Path:
        """File for the output of its processes."""
        return self.folder.with_name(f"{self.name}.log")

    def saved_samples(self) -> int:
        """Control steps up to the newest checkpoint; 0 without one. Errors: :class:`CheckpointError`."""
        checkpoints = list_checkpoints(self.folder)
        return int(read_meta(checkpoints[-1])["counters"]["samples"]) if checkpoints else 0

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to train."""
        return self.saved_samples() >= self.samples

    def arguments(self) -> list[str]:
        """Of ``python -m pace.rl.train``, to begin the run or to resume it."""
        limits = [*search_override(), f"samples={self.samples}", "minutes=0", "progress=false"]
        if list_checkpoints(self.folder):
            modules = [f"plugins=[{','.join(self.plugins)}]"] if self.plugins else []
            return [f"resume={quote(str(self.folder))}", *modules, *limits]
        return [*self.overrides, f"out={quote(str(self.folder))}", *limits]


def check_settings(run: Run) -> Run:
    """Compare the run in the folder, if any, with the requested one.

    Returns the run, with the modules from outside that its overrides name.

    Errors: :class:`ConfigError` that names a key in which they differ, or a wrong key of the request.
    """
    config = load_train_config(list(run.overrides))
    run, asked = replace(run, plugins=tuple(config.plugins)), flat(to_dict(config))
    open_keys = left_open(compose("train", list(run.overrides)))
    checkpoints = list_checkpoints(run.folder)
    if not checkpoints:
        return run
    saved = read_meta(checkpoints[-1])["config"]
    there = flat(to_dict(parse(saved, TrainConfig)))
    for key in sorted(set(asked) | set(there)):
        if key not in open_keys and not _is_free(key, asked) and asked.get(key) != there.get(key):
            what = f"{key} {there.get(key)}, and {asked.get(key)} is asked for"
            raise ConfigError(f"{run.folder} was trained with {what}: give another out=")
    return run


def _is_free(key: str, asked: Mapping[str, object]) -> bool:
    """Whether a run may differ in ``key`` from the request. A run saves the priors that it has derived."""
    derived = "predictor.priors" in asked and key.startswith("predictor.priors")
    return derived or key.split(".")[0] in FREE_KEYS


def flat(tree: dict, prefix: str = "") -> dict:
    """Leaves of nested dictionaries by their dotted keys."""
    leaves = {}
    for key, value in tree.items():
        leaves |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return leaves


def logged_samples(folder: Path) -> int:
    """Control steps in the last row of a run's metrics; 0 without a row."""
    file = folder / METRICS
    if not file.exists():
        return 0
    with file.open("rb") as handle:
        size = handle.seek(0, os.SEEK_END)
        handle.seek(max(0, size - TAIL_BYTES))
        rows = handle.read().decode().splitlines()
    cell = rows[-1].split(",")[LEADING.index("samples") :][:1] if rows else []
    return int(cell[0]) if cell and cell[0].isdigit() else 0


def shares_of_cores(jobs: int) -> list[list[int]]:
    """Cores for each of ``jobs`` processes, at least one; empty lists if the system does not bind to cores.

    With a quota below the number of cores, the first one depends on this process: others have quotas beside it.
    """
    cores, granted = core_set(), usable_cores()
    if not cores:
        return [[] for _ in range(jobs)]
    first = os.getpid() % len(cores) if granted < len(cores) else 0
    cores = sorted([*cores, *cores][first : first + granted])
    return [cores[slot::jobs] or [cores[slot % len(cores)]] for slot in range(jobs)]


@dataclass
class Job:
    """A run with a running process."""

    run: Run
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    started: float = field(default_factory=time.monotonic)

    @classmethod
    def start(cls, run: Run, cores: Sequence[int]) -> Job:
        """Begin or resume ``run`` on ``cores``, in its own process group, so that Ctrl-C does not reach it."""
        run.folder.parent.mkdir(parents=True, exist_ok=True)
        log = run.log.open("ab")
        process = subprocess.Popen(
            [*TRAIN, *run.arguments()],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=({"OMP_NUM_THREADS": str(len(cores))} if cores else {}) | os.environ,
            process_group=0,
        )
        if cores:  # early enough: its threads and workers start later and inherit this
            os.sched_setaffinity(process.pid, cores)
        return cls(run, process, log)

    def failure(self) -> str | None:
        """Why the run is not finished, once its process has ended; None if it is."""
        if self.process.returncode != 0:
            lines = self.run.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            return f"status {self.process.returncode}: {lines[-1] if lines else 'it printed nothing'}"
        return None if self.run.finished else f"ended at {self.run.saved_samples():,} control steps"

    def end(self, kill: bool = False) -> None:
        """Wait for the process, or ``kill`` it first."""
        if kill and self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self.log.close()


class RunQueue:
    """Trains ``runs``, ``jobs`` at a time, with a bar of all their control steps and the time that is left.

    Attributes: ``failures``, the reason by the name of each run that failed; the others still run.
    """

    def __init__(self, runs: Sequence[Run], jobs: int, progress: bool = True) -> None:
        self.runs = runs
        self._shares = shares_of_cores(jobs)
        self._active: dict[int, Job] = {}
        self._done = {run.name: min(run.saved_samples(), run.samples) for run in runs}
        self._waiting = deque(run for run in runs if self._done[run.name] < run.samples)
        self._stop = StopRequest()
        self.failures: dict[str, str] = {}
        interval = 0.2 if sys.stderr.isatty() else SECONDS_PER_LINE
        self._bar = tqdm(
            total=sum(run.samples for run in runs),
            initial=sum(self._done.values()),
            disable=not progress,
            mininterval=interval,
            smoothing=0.0,
            bar_format="{percentage:3.0f}%|{bar:16}| {remaining} left | {desc}",
        )

    def play(self) -> None:
        """Train the unfinished runs. Errors: ``KeyboardInterrupt`` when stopped by Ctrl-C, or :class:`Terminated`.

        The runs are then saved first; a second Ctrl-C does not wait for that.
        """
        with self._stop.listening():
            try:
                self._loop()
            finally:
                for job in self._active.values():
                    job.end(kill=True)
                self._bar.close()
        self._stop.require_not_terminated()
        if self._stop.name is not None:
            raise KeyboardInterrupt

    def _loop(self) -> None:
        told = False
        while self._active or (self._waiting and self._stop.name is None):
            if self._stop.name is not None and not told:
                told = True
                self._say(f"{self._stop.name}: saving {len(self._active)} runs; once more to end at once")
                for job in self._active.values():
                    job.process.send_signal(signal.SIGINT)
            self._fill_slots()
            self._collect()
            self._show()
            time.sleep(POLL_SECONDS)

    def _fill_slots(self) -> None:
        for slot, cores in enumerate(self._shares):
            if slot not in self._active and self._waiting and self._stop.name is None:
                self._active[slot] = Job.start(self._waiting.popleft(), cores)

    def _collect(self) -> None:
        """Record the runs whose processes have ended."""
        for slot, job in list(self._active.items()):
            if job.process.poll() is None:
                continue
            del self._active[slot]
            job.end()
            reason = job.failure()
            self._done[job.run.name] = min(job.run.saved_samples(), job.run.samples)
            if self._stop.name is not None:
                continue
            if reason is not None:
                self.failures[job.run.name] = reason
            ended = "finished" if reason is None else f"FAILED, {reason}"
            self._say(f"{job.run.name}: {ended} after {clock(time.monotonic() - job.started)}")

    def _show(self) -> None:
        for job in self._active.values():
            self._done[job.run.name] = min(logged_samples(job.run.folder), job.run.samples)
        at_work = (f"{job.run.name} {self._done[job.run.name] / 1e6:.2f} M" for job in self._active.values())
        finished = sum(self._done[run.name] >= run.samples for run in self.runs)
        self._bar.set_description_str(f"{finished}/{len(self.runs)} runs | {', '.join(at_work)}", refresh=False)
        self._bar.update(sum(self._done.values()) - self._bar.n)

    def _say(self, text: str) -> None:
        self._bar.write(text)
        sys.stdout.flush()
