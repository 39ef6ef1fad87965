"""The tensors that an object owns, as a dictionary to save and to put back."""

from __future__ import annotations

from torch import Tensor

#: Attributes that a call fills before it reads them.
SCRATCH = ("_mask", "_seed")


def _owned(owner: object) -> dict[str, Tensor]:
    """Tensors that are attributes of ``owner``, without views of others and the mask and seed of the last call."""
    tensors = {name: value for name, value in vars(owner).items() if isinstance(value, Tensor)}
    return {name: value for name, value in tensors.items() if name not in SCRATCH and not value._is_view()}


def snapshot(owner: object) -> dict[str, Tensor]:
    """Copies of the tensors that ``owner`` has as attributes, by name; views are left out."""
    return {name: value.clone() for name, value in _owned(owner).items()}


def restore(owner: object, state: dict[str, Tensor]) -> None:
    """Write the tensors of :func:`snapshot` back in place.

    Errors: ``KeyError`` for a missing tensor, ``RuntimeError`` for another shape.
    """
    for name, value in _owned(owner).items():
        value.copy_(state[name])


def with_prefix(prefix: str, state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors under ``prefix.name``."""
    return {f"{prefix}.{name}": value for name, value in state.items()}


def under_prefix(prefix: str, state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors stored under ``prefix.``, with the prefix taken off."""
    start = f"{prefix}."
    return {name.removeprefix(start): value for name, value in state.items() if name.startswith(start)}
