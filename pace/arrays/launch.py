"""Launches by the names of a kernel's arguments, recorded once and replayed; recorded again for other tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from numbers import Real
from typing import Any, Generic, TypeVar

import torch
import warp as wp
from torch import Tensor

from pace.arrays.streams import torch_stream

T = TypeVar("T")


class LaunchError(ValueError):
    """A launch that does not fit its kernel; the message names both kernel and argument."""


class Launch:
    """A launch that is only replayed when called, on torch's current stream.

    Args:
        kernel: the kernel to launch.
        dim: threads, for instance N for one per world.
        device: of all tensors.
        arguments: by the names of the kernel's arguments, in any order. For an array: a tensor, whose memory is shared
            (for vectors the last dimension holds their numbers), or a Warp array. For a struct: a Warp struct, or an
            object with its fields as attributes or keys, for instance a dataclass of tensors
            (:mod:`pace.arrays.tensors`). For a vector: any sequence. All are kept alive, and read in place at each
            call.

    Errors: :class:`LaunchError` for a missing or unknown name, and for a tensor of another type, shape or device than
    the kernel declares.
    """

    def __init__(
        self, kernel: wp.Kernel, dim: int | tuple[int, ...], device: torch.device, /, **arguments: Any
    ) -> None:
        declared = {argument.label: argument.type for argument in kernel.adj.args}
        _check_names(kernel.key, set(arguments), list(declared))
        self._arguments = arguments  # the launch itself knows them by address
        inputs = [
            _as_argument(f"kernel '{kernel.key}', argument '{name}'", declared[name], arguments[name], device)
            for name in declared
        ]
        self._device = device if device.type == "cuda" else None
        self._launch = wp.launch(kernel, dim=dim, inputs=inputs, device=wp.device_from_torch(device), record_cmd=True)

    def __call__(self) -> None:
        if self._device is None:
            self._launch.launch()
        else:
            self._launch.launch(stream=torch_stream(self._device))


class MaskedLaunch:
    """A launch over the worlds of a mask, which is the kernel's argument ``mask``; see :class:`Launch`."""

    def __init__(
        self, kernel: wp.Kernel, dim: int | tuple[int, ...], device: torch.device, /, **arguments: Any
    ) -> None:
        count = dim if isinstance(dim, int) else dim[0]
        if "mask" in arguments:
            raise LaunchError(f"kernel '{kernel.key}': the argument 'mask' is given with each call, not here")
        self._mask = torch.zeros(count, dtype=torch.bool, device=device)
        self._some = Launch(kernel, dim, device, mask=self._mask, **arguments)
        everyone = torch.ones(count, dtype=torch.bool, device=device)
        self._all = Launch(kernel, dim, device, mask=everyone, **arguments)

    def __call__(self, mask: Tensor | None) -> None:
        """Launch for the worlds of ``mask`` (N,) bool; ``None``: for all."""
        if mask is None:
            self._all()
        else:
            self._mask.copy_(mask)
            self._some()


class Bound(Generic[T]):
    """An object made for the tensors that a caller gives: kept as long as they are the same, rebuilt for others.

    Args:
        make: makes it from the tensors, for instance a :class:`Launch` on them.
        shapes: name -> shape of each of them, in their order; ``None``: any shape.
    """

    def __init__(self, make: Callable[..., T], **shapes: tuple[int, ...] | None) -> None:
        self._make, self._shapes = make, shapes
        self._made: T | None = None
        self._given: tuple[Any, ...] = (None,) * len(shapes)

    def __call__(self, *given: Any) -> T:
        """The object for these tensors. Give the same ones each time: a rebuild takes longer.

        Errors: ``ValueError`` that names a tensor of another shape.
        """
        made = self._made
        for new, old in zip(given, self._given, strict=True):
            if new is not old:
                made = None
        return self._bind(given) if made is None else made

    def _bind(self, given: tuple[Any, ...]) -> T:
        for (name, shape), value in zip(self._shapes.items(), given, strict=True):
            if shape is not None:
                require_shape(name, value, shape)
        made = self._made = self._make(*given)
        self._given = given
        return made


def _check_names(kernel: str, given: set[str], declared: list[str]) -> None:
    faults = []
    for name in sorted(given.difference(declared)):
        close = get_close_matches(name, declared, 1)
        faults.append(f"has no argument '{name}'" + (f" (did you mean '{close[0]}'?)" if close else ""))
    faults += [f"misses argument '{name}'" for name in declared if name not in given]
    if faults:
        raise LaunchError(f"kernel '{kernel}' {', '.join(faults)}; it takes {', '.join(declared)}")


def _as_argument(where: str, declared: Any, value: Any, device: torch.device) -> Any:
    """``value`` as an argument or field of the ``declared`` type."""
    if hasattr(declared, "instance_type"):
        return value if isinstance(value, declared.instance_type) else _as_struct(where, declared, value, device)
    if wp.types.is_array(declared):
        if isinstance(value, Tensor):
            return _as_array(where, declared, value, device)
        if not isinstance(value, wp.array):
            raise LaunchError(f"{where} must be a tensor, not {value!r}")
        return value
    size = getattr(declared, "_shape_", ())
    if isinstance(value, (tuple, list)) and size == (len(value),):
        return declared(*value)
    if isinstance(value, declared) or (size == () and isinstance(value, Real)):
        return value
    raise LaunchError(f"{where} must be {declared.__name__}, not {'a tensor' if isinstance(value, Tensor) else value}")


def _as_struct(where: str, struct: Any, owner: Any, device: torch.device) -> Any:
    """A Warp struct on the memory of the tensors of the same names."""
    made = struct()
    if isinstance(owner, Mapping) and set(owner) - set(struct.vars):
        unknown = ", ".join(sorted(set(owner) - set(struct.vars)))
        raise LaunchError(f"{where} has no field {unknown}; {struct.key} has {', '.join(struct.vars)}")
    known = owner if isinstance(owner, Mapping) else {name: getattr(owner, name, None) for name in struct.vars}
    for name, variable in struct.vars.items():
        if known.get(name) is None:
            raise LaunchError(f"{where} misses '{name}', which {struct.key} has")
        setattr(made, name, _as_argument(f"{where}.{name}", variable.type, known[name], device))
    return made


def table(struct: Any, rows: Iterable[Any], device: torch.device) -> wp.array:
    """An array of Warp structs, each from an object with its fields as attributes or keys. Keep the tensors alive.

    Errors: :class:`LaunchError` as those of :class:`Launch`.
    """
    made = [_as_struct("row", struct, row, device) for row in rows]
    return wp.array(made, dtype=struct, device=wp.device_from_torch(device))


def _as_array(where: str, declared: Any, tensor: Tensor, device: torch.device) -> wp.array:
    """The Warp array of the ``declared`` type on a tensor's memory.

    Errors: :class:`LaunchError` that says ``where``, for a tensor of another type, shape or device.
    """
    element = None if declared.dtype is Any else declared.dtype
    inner = getattr(element, "_shape_", ())
    dtype = tensor.dtype if element is None else wp.dtype_to_torch(getattr(element, "_wp_scalar_type_", element))
    dims = tensor.dim() - len(inner)
    if tensor.dtype != dtype or dims != declared.ndim or tensor.shape[dims:] != inner:
        wanted = ", ".join([*["*"] * declared.ndim, *map(str, inner)])
        raise LaunchError(f"{where} must be {dtype} of shape ({wanted}), not {tensor.dtype} {tuple(tensor.shape)}")
    if tensor.device.type != device.type or (device.index is not None and tensor.device.index != device.index):
        raise LaunchError(f"{where} must lie on {device}, not on {tensor.device}")
    if inner and tensor.stride(-1) != 1:
        raise LaunchError(f"{where} must hold the numbers of each vector contiguously")
    return wp.from_torch(tensor, dtype=element)


def require_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    """Check a shape, as kernels read beyond the end of a small tensor. Errors: ``ValueError`` that names it."""
    if tensor.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {tuple(tensor.shape)}")
