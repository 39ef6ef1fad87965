"""Numbers on a device, read by the host at once."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor


def decimal(value: float) -> float:
    """A number from float32 without the digits that float32 does not have: 1e-5 for 9.99999974737875e-06."""
    return float(str(np.float32(value)))


def read(values: Mapping[str, float | Tensor]) -> dict[str, float]:
    """The tensors () of ``values`` as Python numbers, in float32, and the numbers as they are: one wait in all."""
    tensors = [value.detach().float() for value in values.values() if isinstance(value, Tensor)]
    found = iter(torch.stack(tensors).tolist() if tensors else ())
    return {name: decimal(next(found)) if isinstance(value, Tensor) else value for name, value in values.items()}
