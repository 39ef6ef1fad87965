"""What the robot works out over an episode from its sensors: a kernel over N worlds, and its beginning anew."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from pace.arrays.share import record, share


class Estimate:
    """A kernel that goes one control step on in all worlds, or begins anew in those of a mask.

    Args:
        kernel: its first arguments are the mask and whether it is a restart, 0 or 1.
        inputs: its other arguments.
        count: N.
        device: of the worlds.
    """

    def __init__(self, kernel: wp.Kernel, inputs: list[Any], count: int, device: torch.device) -> None:
        self._mask = torch.zeros(count, dtype=torch.bool, device=device)
        mask = share(self._mask)
        self._update: Callable[[], None] = record(kernel, count, [mask, 0, *inputs], device)
        self._restart: Callable[[], None] = record(kernel, count, [mask, 1, *inputs], device)

    def update(self) -> None:
        """One control step later: the sensors' signals are new."""
        self._update()

    def restart(self, mask: Tensor) -> None:
        """Forget everything in the worlds of ``mask`` (N,) bool, and begin with what they sense now."""
        self._mask.copy_(mask)
        self._restart()
