"""Torch's streams as Warp objects, so that Warp's kernels run in order with torch's."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any

import torch
import warp as wp


def torch_stream(device: torch.device) -> wp.Stream:
    """Torch's current stream on a GPU. Warp's kernels on it run in order with torch's.

    Warp's default stream waits for torch's default one and the other way round, but for no other stream of torch.
    """
    return warp_stream(device, torch.cuda.current_stream(device).cuda_stream)


@cache
def warp_stream(device: torch.device, handle: int) -> wp.Stream:
    """The stream of torch whose ``cuda_stream`` is the handle: one object each, by which Warp knows a capture."""
    return wp.Stream(wp.device_from_torch(device), cuda_stream=handle)


def warp_scope(device: torch.device) -> AbstractContextManager[Any]:
    """Within it Warp works on ``device``, and on a GPU on torch's current stream."""
    if device.type == "cuda":
        return wp.ScopedStream(torch_stream(device), sync_enter=False)
    return wp.ScopedDevice(wp.device_from_torch(device))
