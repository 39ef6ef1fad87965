"""Uniform samples for some of N worlds, made in one kernel: the other worlds cost nothing.

Torch would sample for all N and keep few, in several operators for each quantity. A reset of a few worlds would then
take as long as a reset of all.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from pace.arrays.launch import MaskedLaunch, table


@wp.struct
class ColumnArrays:
    """:class:`Column` in the kernel's form."""

    values: wp.array[wp.float32]
    low: float
    high: float
    least: float
    most: float


@wp.kernel
def _sample(mask: wp.array[wp.bool], seed: wp.array[wp.int32], columns: wp.array[ColumnArrays]):
    """Sample all columns of one world."""
    world = wp.tid()
    if not mask[world]:
        return
    random = wp.rand_init(seed[0], world)
    for i in range(columns.shape[0]):
        column = columns[i]
        value = column.low + wp.randf(random) * (column.high - column.low)
        column.values[world] = wp.clamp(value, column.least, column.most)


class Column(NamedTuple):
    """One number of each world: its storage and its range."""

    values: Tensor  # (N,) float32, of any stride
    low: float
    high: float
    least: float = -float("inf")  # the sample is clamped to these
    most: float = float("inf")


class UniformSampler:
    """Resamples columns of numbers in the worlds of a mask; each call takes one number from the generator.

    Args:
        columns: what is sampled; their tensors are written in place.
        generator: source of the kernel's seeds, on the columns' device.
    """

    def __init__(self, columns: Sequence[Column], generator: torch.Generator) -> None:
        self._columns, self._generator = columns, generator  # the kernel's table knows the tensors by address alone
        num_worlds, device = columns[0].values.shape[0], columns[0].values.device
        self._seed = torch.zeros(1, dtype=torch.int32, device=device)
        rows = table(ColumnArrays, columns, device)
        self._sample = MaskedLaunch(_sample, num_worlds, device, seed=self._seed, columns=rows)

    def __call__(self, mask: Tensor) -> None:
        """Resample in the worlds of ``mask`` (N,) bool; the others keep their values."""
        self._seed.random_(generator=self._generator)
        self._sample(mask)


def columns_of(values: Tensor, ranges: Sequence[Sequence[float]]) -> list[Column]:
    """The columns of ``values`` (N, C), each with its range."""
    return [Column(column, *ends) for column, ends in zip(values.unbind(1), ranges, strict=True)]
