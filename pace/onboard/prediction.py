"""The robot's prediction of the ball, and the base target that follows from it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from pace.config.task import RewardConfig, TaskConfig
from pace.predictor.network import predictor_slices

#: Longer predicted times are clamped to this, s.
LONGEST_TIME = 2.0


def idle_point(config: RewardConfig) -> list[float]:
    """Target of the paddle (m, world frame) that belongs to the idle base position."""
    idle_xy = [base - arm for base, arm in zip(config.idle_base_xy, config.arm_offset, strict=True)]
    return [*idle_xy, config.idle_height]


class Prediction(NamedTuple):
    """``apex`` and paddle's ``target`` (N, 3) m, ``time`` (N,) s until the ball is at the target, ``shift`` (N, 2) m
    from the sensed base to its target."""

    apex: Tensor
    target: Tensor
    time: Tensor
    shift: Tensor


class PredictionReader(nn.Module):
    """Reads the predictor's output. While there is nothing to hit, the idle point replaces it."""

    arm_offset: Tensor
    idle_base: Tensor
    idle_point: Tensor

    def __init__(self, config: TaskConfig) -> None:
        super().__init__()
        reward = config.reward
        self.slices = predictor_slices(config.predictor.outputs)
        self.size = max(columns.stop for columns in self.slices.values())
        self.intercept, self.target_x = reward.target_mode == "intercept", reward.target_x
        for name, value in (
            ("arm_offset", reward.arm_offset),
            ("idle_base", reward.idle_base_xy),
            ("idle_point", idle_point(reward)),
        ):
            self.register_buffer(name, torch.tensor(value), persistent=False)

    def forward(self, prediction: Tensor, something_to_hit: Tensor, base_position: Tensor) -> Prediction:
        """Prediction (N, P) in the order of ``predictor.outputs``, something to hit (N,) bool, base (N, 3) m."""
        hit = something_to_hit.unsqueeze(1)
        parts = {name: prediction[:, columns] for name, columns in self.slices.items()}
        apex, target = (torch.where(hit, point, self.idle_point) for point in (parts["apex"], self._target(parts)))
        above = (target if self.intercept else apex)[:, :2]
        stand = torch.where(hit, above + self.arm_offset, self.idle_base)
        return Prediction(apex, target, self._time(parts, hit).squeeze(1), stand - base_position[:, :2])

    def _target(self, parts: dict[str, Tensor]) -> Tensor:
        apex = parts["apex"]
        return parts.get("target", torch.cat((apex[:, :1].clamp(max=self.target_x), apex[:, 1:]), dim=1))

    def _time(self, parts: dict[str, Tensor], hit: Tensor) -> Tensor:
        if "target_time" not in parts:
            return torch.zeros_like(parts["apex"][:, :1])
        return torch.where(hit, parts["target_time"].clamp(0.0, LONGEST_TIME), 0.0)


def no_prediction(base_position: Tensor) -> Prediction:
    """Without a predictor (ablation) all predicted quantities are zero; base (N, 3)."""
    zero = torch.zeros_like(base_position)
    return Prediction(zero, zero, zero[:, 0], zero[:, :2])
