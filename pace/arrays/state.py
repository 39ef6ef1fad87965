"""State that an object needs to resume: declared tensors, as a dictionary to save and to load."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor


class Stateful:
    """Has a state of tensors, which are allocated once: the attributes that ``STATE`` names, or :meth:`state_tensors`.

    The names are part of the format of checkpoints.
    """

    STATE: ClassVar[tuple[str, ...]] = ()

    def state_tensors(self) -> dict[str, Tensor]:
        """The tensors themselves, by name."""
        return tensors_named(self, self.STATE)

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of the tensors, by name."""
        return {name: tensor.clone() for name, tensor in self.state_tensors().items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Load the result of :meth:`state_dict`, in place.

        Errors: ``KeyError`` for a missing tensor, ``RuntimeError`` for another shape.
        """
        for name, tensor in self.state_tensors().items():
            tensor.copy_(state[name])


def tensors_named(owner: object, names: tuple[str, ...]) -> dict[str, Tensor]:
    """Attributes of ``owner`` by name."""
    return {name: getattr(owner, name) for name in names}


def with_prefix(prefix: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors under ``prefix.name``."""
    return {f"{prefix}.{name}": value for name, value in state.items()}


def under_prefix(prefix: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors stored under ``prefix.``, with the prefix taken off."""
    start = f"{prefix}."
    return {name.removeprefix(start): value for name, value in state.items() if name.startswith(start)}
