"""Measuring several functions in turn, so that a slow moment of the machine affects all of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

import torch


def median_seconds(
    measured: Mapping[str, Callable[[], object]],
    repeats: int,
    device: torch.device,
    before: Callable[[], None] | None = None,
) -> dict[str, float]:
    """Median wall-clock seconds of each callable of ``measured``, called in turn ``repeats`` times.

    Each is called once unmeasured first, for compilation and allocation. ``before`` runs, unmeasured, ahead of every
    turn.
    """
    seconds: dict[str, list[float]] = {name: [] for name in measured}
    for turn in range(repeats + 1):
        if before is not None:
            before()
        for name, call in measured.items():
            started = time.perf_counter()
            call()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            if turn > 0:
                seconds[name].append(time.perf_counter() - started)
    return {name: statistics.median(values) for name, values in seconds.items()}
