"""Torch tensors as Warp arrays on the same memory, and recorded launches among torch's own kernels."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache, partial
from typing import Any

import torch
import warp as wp
from torch import Tensor


def share(tensor: Tensor) -> wp.array:
    """The Warp array on a tensor's memory; rows (N, 3) are vectors. Keep the tensor alive."""
    rows = tensor.dtype == torch.float32 and tensor.dim() == 2 and tensor.shape[1] == 3
    return wp.from_torch(tensor, dtype=wp.vec3 if rows else None)


def require_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    """Kernels read by index, beyond the end of a tensor that is too small. Errors: ``ValueError`` that names it."""
    if tensor.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {tuple(tensor.shape)}")


def torch_stream(device: torch.device) -> wp.Stream:
    """Torch's current stream on a GPU. Warp's work given to it keeps its place among torch's own kernels.

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


def record(
    kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list[Any], device: torch.device
) -> Callable[[], None]:
    """A launch, over N worlds for instance, that is only replayed when called, on torch's current stream."""
    launch = wp.launch(kernel, dim=dim, inputs=inputs, device=wp.device_from_torch(device), record_cmd=True)
    return partial(_replay, launch, device, inputs)


def _replay(launch: wp.Launch, device: torch.device, _kept: list[Any]) -> None:
    """Launch again. ``_kept``: the arrays, which the launch itself knows by address."""
    if device.type == "cuda":
        launch.launch(stream=torch_stream(device))
    else:
        launch.launch()
