"""The physics-based predictor as a plain function: bounce, apex and landing of a flight."""

from __future__ import annotations

from functools import lru_cache

import torch
from omegaconf import OmegaConf
from torch import Tensor

from pace.config.ball import TableConfig
from pace.config.base import config_dir
from pace.sim.ball.ball import DEFAULT_PRESET, BallParams, BallSim, Forecast, ball_preset


@lru_cache
def _ball_dt() -> float:
    """s, the longest sub-step of a flight, from the engines' configurations."""
    solver = OmegaConf.load(config_dir() / "engine" / "_solver.yaml")
    return float(OmegaConf.select(solver, "ball_dt", throw_on_missing=True))


def forecast_flight(
    position: Tensor,
    velocity: Tensor,
    spin: Tensor | None = None,
    params: BallParams | None = None,
    table: TableConfig | None = None,
    intercept_x: float = -1.6,
) -> Forecast:
    """Simulate the flight of N balls ahead, with table, net and floor but without paddles, and return its events.

    Args:
        position: (N, 3) m, world frame (origin on the floor below the table's centre, x to the opponent, z up).
        velocity: (N, 3) m/s.
        spin: (N, 3) rad/s; ``None`` is no spin.
        params: ball, air and contacts, numbers or tensors (N,); ``None`` is the preset of the default configuration.
        table: table, net and floor; ``None`` takes those of the same preset.
        intercept_x: m, of :attr:`Forecast.intercept`.

    Returns:
        :class:`pace.sim.ball.Forecast`: tensors (N, ...) on the device of ``position``, in m and s from now, NaN if an
        event does not occur, and for numbers beyond float32. The flight is that of the simulation.

    Errors: ``ValueError`` for another shape than (N, 3).
    """
    spin = torch.zeros_like(position) if spin is None else spin
    for name, value in (("position", position), ("velocity", velocity), ("spin", spin)):
        if value.dim() != 2 or value.shape != position.shape or value.shape[1] != 3:
            raise ValueError(f"{name} must have shape (N, 3) with one N for all, not {tuple(value.shape)}")
    preset = ball_preset(DEFAULT_PRESET)
    count, device = position.shape[0], position.device
    sim = BallSim(
        count, device, params or BallParams.from_config(preset), table or preset.table, _ball_dt(), 1, _ball_dt()
    )
    everyone = torch.ones(count, dtype=torch.bool, device=device)
    sim.forecast(everyone, position, velocity, spin, intercept_x)
    for values in vars(sim.forecast_result).values():
        if isinstance(values, Tensor) and values.is_floating_point():
            values.masked_fill_(values.isinf(), torch.nan)  # beyond float32
    return sim.forecast_result
