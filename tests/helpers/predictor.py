"""A small predictor, and serves for it to learn from."""

from __future__ import annotations

import torch

from pace.config.task import PredictorConfig
from pace.config.training import load_train_config


def predictor_config(**changes: object) -> PredictorConfig:
    config = load_train_config().predictor
    for name, value in changes.items():
        setattr(config, name, value)
    return config


def serves(count: int, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """Five positions, 20 ms apart, of balls in free fall, and where they are 0.3 s after the last."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: list[float], high: list[float]) -> torch.Tensor:
        return torch.tensor(low) + (torch.tensor(high) - torch.tensor(low)) * torch.rand(count, 3, generator=generator)

    start = uniform([-0.2, -0.3, 0.9], [0.8, 0.3, 1.1])
    velocity = uniform([-6.5, -0.8, 0.5], [-5.0, 0.4, 2.0])
    drop = torch.tensor([0.0, 0.0, -4.905])

    def at(time: torch.Tensor) -> torch.Tensor:
        return start[:, None] + velocity[:, None] * time[:, None] + drop * time[:, None] ** 2

    frames = at(torch.arange(-4, 1) * 0.02)
    return frames.flatten(1), at(torch.tensor([0.3]))[:, 0]
