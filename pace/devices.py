"""The devices of this machine: its CPU and its GPUs, and what keeps a GPU from being used."""

from __future__ import annotations

import os
import re
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch

from pace.config.automatic import Machine, most_worlds
from pace.config.base import ConfigError
from pace.memory import GIB, available_memory

VISIBLE = "CUDA_VISIBLE_DEVICES"  # NVIDIA's: which GPUs a process may see
TORCH_INDEX = "pip install torch --index-url https://download.pytorch.org/whl/cu130"
#: Files that NVIDIA's kernel driver makes (the last one under WSL).
DRIVER_FILES = ("/proc/driver/nvidia/version", "/dev/nvidiactl", "/dev/dxg")


def resolve_device(device: str | torch.device) -> torch.device:
    """``auto``, ``cpu``, ``cuda`` or ``cuda:1`` as a torch device; ``auto`` is the first GPU, or the CPU without one.

    If a GPU is there and torch cannot see it, ``auto`` says so in one line.

    Errors: :class:`ConfigError` for a device that is unknown or missing, and for a GPU that torch or Warp cannot use.
    """
    try:
        resolved = torch.device("cuda" if str(device) == "auto" else device)
    except RuntimeError as error:
        raise ConfigError(f"device must be auto, cpu, cuda or cuda:<number>, not {device!r}") from error
    if resolved.type not in ("cpu", "cuda"):
        raise ConfigError(f"device must be auto, cpu, cuda or cuda:<number>, not {str(device)!r}")
    if resolved.type == "cpu":
        return torch.device("cpu")
    seen, index = seen_by_torch(), resolved.index or 0
    if str(device) == "auto" and seen.count == 0:
        if has_driver() and os.environ.get(VISIBLE) != "":
            _say(f"warning: device=auto is the CPU, though a GPU's driver is here: {why_not_seen(seen)}")
        return torch.device("cpu")
    if index >= seen.count:
        reason = f": {why_not_seen(seen)}" if seen.count == 0 else visible_in_words()
        raise ConfigError(f"device {device} is not there: torch sees {seen.count} GPU(s){reason}; use device=cpu")
    require_usable(index)
    return torch.device("cuda", index)


@cache
def _say(line: str) -> None:
    print(line, file=sys.stderr)


class SeenByTorch(NamedTuple):
    """What torch knows of GPUs: its version, the CUDA that it is built for (None: without), and how many it sees."""

    version: str
    cuda: str | None
    count: int


def seen_by_torch() -> SeenByTorch:
    """What it knows now."""
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    return SeenByTorch(str(torch.__version__), torch.version.cuda, count)


def has_driver() -> bool:
    """Whether NVIDIA's driver is loaded on this machine."""
    return any(Path(file).exists() for file in DRIVER_FILES)


def visible_in_words() -> str:
    """`` (CUDA_VISIBLE_DEVICES=1)``; empty if it is not set."""
    value = os.environ.get(VISIBLE)
    return "" if value is None else f" ({VISIBLE}={value})"


def why_not_seen(seen: SeenByTorch) -> str:
    """Why torch sees no GPU, and the cure."""
    if seen.cuda is None:
        return f"torch {seen.version} is built without CUDA ({TORCH_INDEX})"
    if os.environ.get(VISIBLE) is not None:
        return f"{VISIBLE}={os.environ[VISIBLE]} names none of its GPUs (unset it)"
    if not has_driver():
        return "no NVIDIA driver is loaded"
    return f"its driver may be too old for CUDA {seen.cuda} of torch {seen.version} (nvidia-smi shows it; update it)"


class Card(NamedTuple):
    """A GPU: name, compute capability (9, 0), and the architectures that torch has code for (sm_90, compute_90)."""

    name: str
    capability: tuple[int, int]
    built_for: tuple[str, ...]


class SeenByWarp(NamedTuple):
    """What Warp knows of GPUs: its version, the CUDA of its toolkit and of the driver (None: not there), how many it
    sees, and the oldest architecture (75: sm_75) that it compiles for."""

    version: str
    toolkit: tuple[int, int] | None
    driver: tuple[int, int] | None
    count: int
    oldest: int


def card(index: int) -> Card:
    """A GPU that torch sees."""
    built_for = tuple(torch.cuda.get_arch_list())
    return Card(torch.cuda.get_device_name(index), torch.cuda.get_device_capability(index), built_for)


def seen_by_warp() -> SeenByWarp:
    """What it knows now."""
    import warp as wp

    wp.init()
    oldest = min(wp._src.context.runtime.nvrtc_supported_archs, default=0)
    driver = wp.get_cuda_driver_version()
    return SeenByWarp(wp.__version__, wp.get_cuda_toolkit_version(), driver, wp.get_cuda_device_count(), oldest)


@cache
def require_usable(index: int) -> None:
    """Errors: :class:`ConfigError` for a GPU for which torch has no code, or that Warp cannot use. Torch would fail at
    its first operator; Warp would go to the CPU in silence, and torch would not."""
    found, warp = card(index), seen_by_warp()
    here = f"cuda:{index} ({found.name}, sm_{found.capability[0]}{found.capability[1]})"
    if not has_code_for(found):
        known = ", ".join(found.built_for)
        raise ConfigError(
            f"{here}: torch {torch.__version__} has no code for it ({known}): another torch has ({TORCH_INDEX}, or an "
            "older one for an old card); use device=cpu"
        )
    fault = _fault_of_warp(found, warp, index)
    if fault is not None:
        raise ConfigError(f"{here}: torch can use it and Warp {warp.version} cannot: {fault}; use device=cpu")


def has_code_for(found: Card) -> bool:
    """Whether torch can run on a card: programs (sm_86) run on cards of their generation that are not older, PTX
    (compute_86) on all that are not older; those of one card alone (sm_90a) on that card."""
    for arch in found.built_for:
        form = re.fullmatch(r"(sm|compute)_(\d+)(\d)([af]?)", arch)
        if form is None:
            return True  # not NVIDIA's names: nothing is known
        known = (int(form[2]), int(form[3]))
        if form[4] == "a":
            fits = known == found.capability
        else:
            fits = known <= found.capability and (form[1] == "compute" or known[0] == found.capability[0])
        if fits:
            return True
    return not found.built_for


def _fault_of_warp(found: Card, warp: SeenByWarp, index: int) -> str | None:
    """Why Warp cannot use a card, and the cure; None if it can."""
    if warp.toolkit is None:
        return "it is built without CUDA (pip install warp-lang on Linux or Windows)"
    needs = f"CUDA {warp.toolkit[0]}.{warp.toolkit[1]}"
    if index >= warp.count:
        if warp.count == 0 and warp.driver is not None and warp.driver < warp.toolkit:
            has = f"CUDA {warp.driver[0]}.{warp.driver[1]}"
            return (
                f"the driver ({has}) is older than Warp's toolkit ({needs}): update the driver, or install the Warp "
                "that is built for CUDA 12 (+cu12 at https://github.com/NVIDIA/warp/releases)"
            )
        return f"it sees {warp.count} GPU(s){visible_in_words()}"
    if 10 * found.capability[0] + found.capability[1] < warp.oldest:
        return f"its toolkit ({needs}) begins at sm_{warp.oldest}: the Warp that is built for CUDA 12 may know the card"
    return None


def memory_pool_is_off(device: torch.device) -> bool:
    """Whether Warp cannot allocate memory within a capture on this GPU."""
    import warp as wp

    return not wp.is_mempool_enabled(wp.device_from_torch(device))


def out_of_memory(error: BaseException) -> bool:
    """Whether an error says that a GPU's memory is full: torch's, or the one of Warp, which has no type for it."""
    if isinstance(error, torch.OutOfMemoryError):
        return True
    text = str(error)
    full = re.search(r"Failed to allocate \d+ bytes .*on device 'cuda|CUDA error.*out of memory", text)
    return isinstance(error, RuntimeError) and full is not None and "memory pools are not" not in text


def full_memory_in_words(error: BaseException, device: torch.device | None = None) -> str:
    """One line for an error that is :func:`out_of_memory`, with the number of worlds that fit by estimate. The GPU is
    the one that the error names; if it names none, ``device``, or else torch's current one."""
    named = re.search(r"\bGPU (\d+) has|on device 'cuda:(\d+)'", str(error))
    full = device if named is None else torch.device("cuda", int(named[1] or named[2]))
    free, total = (size / GIB for size in torch.cuda.mem_get_info(full))
    fit = f"by estimate a training run of {most_worlds(total):,} worlds fits if nothing else runs there"
    return f"the GPU's memory is full ({total:.1f} GiB, {free:.1f} free): {fit}; give a smaller num_worlds"


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
