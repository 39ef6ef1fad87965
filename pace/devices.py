"""The devices of this machine: its CPU and its GPUs."""

from __future__ import annotations

import torch

from pace.config.automatic import Machine
from pace.config.base import ConfigError
from pace.memory import GIB, available_memory


def resolve_device(device: str | torch.device) -> torch.device:
    """``auto``, ``cpu``, ``cuda`` or ``cuda:1`` as a torch device; ``auto`` is the first GPU, or the CPU without one.

    Errors: :class:`ConfigError` for a device that is unknown or missing.
    """
    if str(device) == "auto":
        return torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    try:
        resolved = torch.device(device)
    except RuntimeError as error:
        raise ConfigError(f"device must be auto, cpu, cuda or cuda:<number>, not {device!r}") from error
    if resolved.type not in ("cpu", "cuda"):
        raise ConfigError(f"device must be auto, cpu, cuda or cuda:<number>, not {str(device)!r}")
    if resolved.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (resolved.index or 0) >= count:
            raise ConfigError(f"device {device} is not there: torch sees {count} GPU(s); use device=cpu")
        return torch.device("cuda", resolved.index or 0)
    return torch.device("cpu")


def has_bf16(device: torch.device) -> bool:
    """Whether ``device`` has units for bf16."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.cpu._is_avx512_bf16_supported()


def machine_of(device: torch.device, count: int = 1) -> Machine:
    """What ``auto`` depends on, with ``count`` of these devices."""
    if device.type == "cuda":
        memory = torch.cuda.get_device_properties(device).total_memory / GIB
        return Machine("cuda", memory, has_bf16(device), count)
    return Machine("cpu", available_memory(), has_bf16(device))
