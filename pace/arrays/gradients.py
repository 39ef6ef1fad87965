"""The gradients of networks in one buffer, allocated once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn


class Gradients:
    """The gradients of groups of parameters, one after another in one buffer: a graph writes them in place, and
    processes exchange them in one message.

    Attributes: ``flat`` (n,) float32, all of them; ``first`` (), a spare number at its beginning; ``parts`` the slices
    of the groups, the first of which begins with that number.

    Args: groups: of parameters, float32 on one device; their ``grad`` becomes a view of the buffer.
    """

    def __init__(self, *groups: Sequence[nn.Parameter]) -> None:
        sizes = [sum(parameter.numel() for parameter in group) for group in groups]
        sizes[0] += 1
        self.flat = torch.zeros(sum(sizes), device=groups[0][0].device)
        self.first, rest = self.flat[0], self.flat[1:]
        self.parts = self.flat.split(sizes)
        parameters = [parameter for group in groups for parameter in group]
        pieces = rest.split([parameter.numel() for parameter in parameters])
        for parameter, piece in zip(parameters, pieces, strict=True):
            parameter.grad = piece.view_as(parameter)

    def zero_(self) -> None:
        """Set all to zero: the next backward pass adds to them."""
        self.flat.zero_()
