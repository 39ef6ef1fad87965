"""Finds what a CUDA graph could not hold, on a CPU: reads of the host, waits, values that Python brings."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import torch
import warp as wp
from torch import Tensor
from warp._src import context

PACKAGE = Path(__file__).resolve().parents[1]
#: Files of the machinery, whose own lines say nothing.
MACHINERY = {str(Path(__file__).with_name(f"{name}.py")) for name in ("watch", "steps", "dry", "dry_warp", "graph")}
#: Operators whose result, or its shape, the host must wait for.
WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "equal", "is_nonzero")
#: Operators that carry values of the host to the device.
BRINGING = ("lift_fresh", "lift_fresh_copy")
#: Functions that hand values to the host, or wait, without an operator when the values lie there already.
REFUSED: tuple[tuple[Any, tuple[str, ...]], ...] = (
    (Tensor, ("numpy", "tolist", "cpu", "__array__")),
    (wp.array, ("numpy", "list")),
    (wp, ("synchronize", "synchronize_device", "synchronize_stream", "synchronize_event")),
    (torch.cuda, ("synchronize",)),
)


class DryRunError(RuntimeError):
    """Something that a CUDA graph could not hold; the message names it, with file and line."""


def place() -> str:
    """File and line of this project that is being run; without one, of the innermost file that is not installed."""
    frame: FrameType | None = sys._getframe(1)
    other = "?"
    while frame is not None:
        file = frame.f_code.co_filename
        if file not in MACHINERY:
            if file.startswith(str(PACKAGE)):
                return f"{Path(file).relative_to(PACKAGE.parent)}:{frame.f_lineno}"
            if other == "?" and "site-packages" not in file and not file.startswith((sys.prefix, sys.base_prefix)):
                other = f"{file}:{frame.f_lineno}"
        frame = frame.f_back
    return other


def require_no_wait(func: Any, args: tuple[Any, ...]) -> None:
    """Errors: :class:`DryRunError` for an operator that waits for the device, such as an index by a mask, whose size
    only the device knows; and for one that brings a value of the host."""
    name = func.overloadpacket.__name__
    if name.startswith(WAITING) or (name.startswith("index") and any(map(_is_mask, _indices(args)))):
        raise DryRunError(f"{place()}: the host reads a tensor ({func})")
    if name in BRINGING:
        raise DryRunError(f"{place()}: a value of the host becomes a tensor ({func})")


def _indices(args: tuple[Any, ...]) -> list[Any]:
    return list(args[1]) if len(args) > 1 and isinstance(args[1], (list, tuple)) else []


def _is_mask(index: Any) -> bool:
    return isinstance(index, Tensor) and index.dtype in (torch.bool, torch.uint8)


@contextmanager
def replaced(*replacements: tuple[Any, str, Any]) -> Iterator[None]:
    """Within it, attributes (owner, name, value) have other values."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in replacements]
    try:
        for owner, name, value in replacements:
            setattr(owner, name, value)
        yield
    finally:
        for owner, name, value in reversed(before):
            setattr(owner, name, value)


@contextmanager
def watched() -> Iterator[None]:
    """Within it, what waits without an operator of torch, and modules of Warp that are loaded only now, raise
    :class:`DryRunError`."""
    refused = [(owner, name, _refuse(f"{owner.__name__}.{name}")) for owner, names in REFUSED for name in names]
    with replaced(*refused), loads_refused():
        yield


def _refuse(name: str) -> Callable[..., NoReturn]:
    def refuse(*_args: Any, **_kwargs: Any) -> NoReturn:
        raise DryRunError(f"{place()}: the host reads or waits ({name})")

    return refuse


@contextmanager
def loads_refused() -> Iterator[None]:
    """Within it a launch of a kernel whose module is not loaded yet, or no longer, raises :class:`DryRunError` that
    names the kernel. Warp would load it, which a capture does not survive."""
    launched, load = ["?"], context.Module.load

    def named(launch: Any) -> Any:
        def launching(kernel: Any, *args: Any, **kwargs: Any) -> Any:
            launched[0] = kernel.key
            return launch(kernel, *args, **kwargs)

        return launching

    def checked(module: Any, device: Any, block_dim: int | None = None, *args: Any, **kwargs: Any) -> Any:
        known = module.execs.get((wp.get_device(device).context, block_dim or module.options["block_dim"]))
        found = None if known is None else load(module, device, block_dim, *args, **kwargs)
        if found is None or found is not known:
            where = f"{place()}: kernel '{launched[0]}' is used for the first time, or was unloaded"
            raise DryRunError(f"{where}: Warp's module {module.name} is loaded in a call that a graph would hold")
        return found

    launches = [(owner, "launch", named(owner.launch)) for owner in (wp, context)]
    with replaced(*launches, (context.Module, "load", checked)):
        yield
