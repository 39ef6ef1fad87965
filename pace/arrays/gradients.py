"""The gradients of networks in one buffer, allocated once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn


class Gradients:
    """The gradients of groups of parameters. After :meth:`hold` they lie one after another in one buffer: a graph
    writes them in place, and processes exchange them in one message.

    Attributes: ``flat`` (n,) float32, the buffer; ``first`` (), a spare number at its beginning; ``parts`` the slices
    of the groups, the first of which begins with that number.

    Args: groups: of parameters, float32 on one device.
    """

    def __init__(self, *groups: Sequence[nn.Parameter]) -> None:
        sizes = [sum(parameter.numel() for parameter in group) for group in groups]
        sizes[0] += 1
        self.flat = torch.zeros(sum(sizes), device=groups[0][0].device)
        self.first = self.flat[0]
        self.parts = self.flat.split(sizes)
        self._parameters = [parameter for group in groups for parameter in group]
        self._held = False

    def hold(self) -> None:
        """From now on the parameters' ``grad`` are views of the buffer."""
        pieces = self.flat[1:].split([parameter.numel() for parameter in self._parameters])
        for parameter, piece in zip(self._parameters, pieces, strict=True):
            parameter.grad = piece.view_as(parameter)
        self._held = True

    def zero_(self) -> None:
        """Forget all: the next backward pass adds to zero, or makes new ones if they are not held, which is faster."""
        if self._held:
            self.flat.zero_()
            return
        for parameter in self._parameters:
            parameter.grad = None
