"""Structs of arrays, declared once: a dataclass of tensors for torch, and the Warp struct that follows from it.

A field's annotation declares its elements: ``hit: Bool`` is one flag for each world, ``foot_force: Annotated[Vec3,
"feet"]`` one vector for each foot of each world, ``InfFloat`` a number that begins infinite. A field may be such a
dataclass itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from typing import Annotated, Any, NamedTuple, TypeVar, get_type_hints

import torch
import warp as wp
from torch import Tensor

T = TypeVar("T")

Float = Annotated[Tensor, wp.float32]
Int = Annotated[Tensor, wp.int32]
Bool = Annotated[Tensor, wp.bool]
Vec2 = Annotated[Tensor, wp.vec2]  # (N, 2) float32 to torch
Vec3 = Annotated[Tensor, wp.vec3]
Vec4 = Annotated[Tensor, wp.vec4]


@dataclass(frozen=True)
class Start:
    """The initial value of a field's numbers; 0 without it."""

    value: float


InfFloat = Annotated[Float, Start(math.inf)]
NanFloat = Annotated[Float, Start(math.nan)]
NanVec3 = Annotated[Vec3, Start(math.nan)]


class _Field(NamedTuple):
    """A field's declaration: type of an element, further dimensions after the worlds, first value."""

    dtype: Any
    dims: tuple[str, ...]
    start: float


@cache
def _layout(declared: type) -> dict[str, _Field | type]:
    """Name -> declaration; the dataclass itself for a field that is one."""
    hints = get_type_hints(declared, include_extras=True)
    return {f.name: _field(hints[f.name]) for f in fields(declared)}


def _field(hint: Any) -> _Field | type:
    if not hasattr(hint, "__metadata__"):
        return hint
    dtype, *more = hint.__metadata__
    starts = [entry.value for entry in more if isinstance(entry, Start)]
    return _Field(dtype, tuple(entry for entry in more if isinstance(entry, str)), starts[0] if starts else 0.0)


def allocate(declared: type[T], count: int, device: torch.device | str, **sizes: int) -> T:
    """An instance of the dataclass ``declared`` whose tensors are new, each (count, *dims, *element).

    ``sizes``: of the dimensions that the fields name. Errors: ``KeyError`` for a size that is not given.
    """
    made: dict[str, Any] = {}
    for name, field in _layout(declared).items():
        if isinstance(field, _Field):
            shape = (count, *(sizes[dim] for dim in field.dims), *getattr(field.dtype, "_shape_", ()))
            dtype = wp.dtype_to_torch(getattr(field.dtype, "_wp_scalar_type_", field.dtype))
            made[name] = torch.full(shape, field.start, dtype=dtype, device=device)
        else:
            made[name] = allocate(field, count, device, **sizes)
    return declared(**made)


def named_tensors(owner: Any) -> dict[str, Tensor]:
    """All tensors of an instance of such a dataclass; those of a field that is one itself as ``field.name``."""
    tensors: dict[str, Tensor] = {}
    for name, field in _layout(type(owner)).items():
        value = getattr(owner, name)
        if isinstance(field, _Field):
            tensors[name] = value
        else:
            tensors |= {f"{name}.{key}": tensor for key, tensor in named_tensors(value).items()}
    return tensors


_STRUCTS: dict[type, Any] = {}


def struct_of(declared: type) -> Callable[[type], Any]:
    """Decorator of an empty class: makes it the Warp struct with the fields of ``declared``, for kernels' arguments."""

    def struct(named: type) -> Any:
        named.__annotations__ = {name: _kernel_type(field) for name, field in _layout(declared).items()}
        return _STRUCTS.setdefault(declared, wp.struct(named))

    return struct


def _kernel_type(field: _Field | type) -> Any:
    if isinstance(field, _Field):
        return (wp.array, wp.array2d, wp.array3d)[len(field.dims)][field.dtype]
    if field not in _STRUCTS:
        struct_of(field)(type(field.__name__, (), {"__module__": field.__module__}))
    return _STRUCTS[field]
