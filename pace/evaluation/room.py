"""Whether the worlds of an evaluation, and the records of its serves, fit into the memory: asked before the first."""

from __future__ import annotations

import torch

from pace.config.automatic import require_memory
from pace.config.base import require
from pace.evaluation.records import COLUMNS
from pace.memory import GIB, available_memory

COPIES = 4  # of the record of a serve (float32) at most: on the device, and while tables and figures are made


def require_room(serves: int, worlds: int, device: torch.device) -> None:
    """Errors: :class:`pace.config.ConfigError` if ``worlds`` at once, on a CPU, or ``serves`` in all do not fit."""
    left = available_memory()
    if device.type == "cpu":
        require_memory(worlds, 1, left)
    needed = COPIES * 4.0 * len(COLUMNS) * serves / GIB
    require(
        needed <= left,
        f"the records of {serves:,} serves need about {needed:.1f} GiB of memory, and {left:.1f} are left: give fewer "
        "serves=, balls_per_world= or warmup_serves=",
    )
