"""Training beside other programs: what is left of its speed when they keep cores busy, or when it is given less."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

from pace.bench.training import training_run
from pace.config.commands import BenchConfig
from pace.cores import core_set

BUSY = "while True: pass"


def neighbour_rates(config: BenchConfig, overrides: list[str]) -> dict[str, float]:
    """Control steps a second of training alone; beside one and two busy processes; at ``nice 10`` beside two; and on
    one core. What the system has no program for is left out."""
    measured = {"train_alone_steps_per_s": _rate(config, overrides)}
    with busy(1):
        measured["train_beside_one_steps_per_s"] = _rate(config, overrides)
    with busy(2):
        measured["train_beside_two_steps_per_s"] = _rate(config, overrides)
        if _has("nice"):
            measured["train_nice_beside_two_steps_per_s"] = _rate(config, overrides, ("nice", "-n", "10"))
    if core_set() and _has("taskset"):
        measured["train_one_core_steps_per_s"] = _rate(config, overrides, ("taskset", "-c", str(core_set()[0])))
    return measured


def _rate(config: BenchConfig, overrides: list[str], prefix: Sequence[str] = ()) -> float:
    return training_run(config.num_worlds, config.bench.train_updates, overrides, prefix)[0]


def _has(program: str) -> bool:
    if shutil.which(program):
        return True
    print(f"  what needs {program} is left out: there is no such program here", flush=True)
    return False


@contextmanager
def busy(count: int) -> Iterator[None]:
    """So many other processes that each keep a core busy while the block runs."""
    with ExitStack() as stack:
        for _ in range(count):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-c", BUSY]))
            stack.callback(process.kill)
        yield
