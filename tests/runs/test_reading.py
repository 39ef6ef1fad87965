"""Numbers on a device become Python's in one read."""

from __future__ import annotations

import math

import pytest
import torch

from pace.runs.reading import decimal, read


def test_all_tensors_are_read_at_once_and_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    reads, tolist = [], torch.Tensor.tolist

    def counted(tensor: torch.Tensor) -> object:
        reads.append(tensor.shape)
        return tolist(tensor)

    monkeypatch.setattr(torch.Tensor, "tolist", counted)
    given = {"a": torch.tensor(True), "b": 0.25, "c": torch.tensor(1e-3), "d": torch.tensor(3, dtype=torch.int32)}
    assert list(read(given).items()) == [("a", 1.0), ("b", 0.25), ("c", 1e-3), ("d", 3.0)]
    assert reads == [(3,)]
    assert read({"b": 1.5}) == {"b": 1.5}
    assert len(reads) == 1


def test_a_number_has_no_digits_that_float32_has_not() -> None:
    rate = torch.tensor(1e-5)
    assert rate.item() != 1e-5
    assert decimal(rate.item()) == 1e-5
    assert torch.tensor(decimal(torch.tensor(2 / 3).item())) == torch.tensor(2 / 3)
    assert math.isnan(decimal(math.nan))
