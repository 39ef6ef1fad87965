"""The measured coefficients of the air (``ball.air``) in the kernels' form."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from pace.config.ball import AirConfig
from pace.sim.ball.aero import AirTables


def air_tensors(air: AirConfig, device: torch.device | str) -> tuple[Tensor, Tensor]:
    """Rows of the drag table (R, 1 + 2 K) and of the lift table (Q, 7), float32."""
    drag = torch.tensor([[row.speed, *row.ratio, *row.coefficient] for row in air.drag])
    lift = torch.tensor([[r.speed, r.slope, r.offset, r.bend, r.quadratic, r.linear, r.constant] for r in air.lift])
    return drag.to(device), lift.to(device)


def air_tables(tensors: tuple[Tensor, Tensor]) -> AirTables:
    """The struct of :func:`air_tensors`, whose memory it shares: keep them as long as it."""
    tables = AirTables()
    tables.drag, tables.lift = (wp.from_torch(tensor) for tensor in tensors)
    return tables
