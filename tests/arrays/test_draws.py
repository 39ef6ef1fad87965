"""Draws in the kernel: their ranges, how even and independent they are, and whom they leave alone."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pace.arrays.draws import Column, UniformSampler, columns_of

WORLDS = 20000
EVERY = torch.ones(WORLDS, dtype=torch.bool)
RANGES = [(0.0, 1.0), (-3.0, -1.0), (5.0, 5.0), (0.2, 0.7)]


def sampler(seed: int = 0) -> tuple[UniformSampler, Tensor]:
    """Draws of four columns, and the tensor that holds them."""
    values = torch.zeros(WORLDS, len(RANGES))
    return UniformSampler(columns_of(values, RANGES), torch.Generator().manual_seed(seed)), values


def test_draws_are_uniform_in_their_ranges() -> None:
    sample, values = sampler()
    sample(EVERY)
    for column, (low, high) in zip(values.unbind(1), RANGES, strict=True):
        width = high - low
        assert low <= float(column.min()) <= low + 1e-3 * width
        assert high - 1e-3 * width <= float(column.max()) <= high
        assert float(column.mean()) == pytest.approx(0.5 * (low + high), abs=0.01 * width + 1e-6)
        assert float(column.std()) == pytest.approx(width / math.sqrt(12.0), rel=0.02, abs=1e-6)
    share = values[:, 0].histc(20, 0.0, 1.0) / WORLDS
    assert float((share - 0.05).abs().max()) < 0.006  # four standard deviations


def test_columns_worlds_and_calls_are_independent() -> None:
    sample, values = sampler()
    sample(EVERY)
    first = values[:, [0, 1, 3]].clone()
    sample(EVERY)
    second = values[:, [0, 1, 3]]
    neighbours = [first[:-1], first[1:], first.roll(64, 0)[1:], second[1:]]
    table = torch.cat(neighbours, dim=1).T.corrcoef()
    assert float((table - torch.eye(len(table))).abs().max()) < 0.03  # four standard deviations


def test_other_worlds_keep_what_they_have_and_a_seed_repeats() -> None:
    sample, values = sampler(3)
    sample(EVERY)
    before = values.clone()
    mask = torch.arange(WORLDS) % 3 == 0
    sample(mask)
    assert torch.equal(values[~mask], before[~mask])
    assert bool((values[mask, 0] != before[mask, 0]).all())
    again, others = sampler(3)
    again(EVERY)
    again(mask)
    assert torch.equal(others, values)


def test_draws_are_kept_within_their_limits() -> None:
    values = torch.zeros(WORLDS)
    UniformSampler([Column(values, 0.0, 1.0, 0.25, 0.5)], torch.Generator().manual_seed(1))(EVERY)
    assert (float(values.min()), float(values.max())) == (0.25, 0.5)
    assert float((values == 0.5).float().mean()) == pytest.approx(0.5, abs=0.02)
