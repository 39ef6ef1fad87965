"""The learning rate that follows the KL divergence of the updates, on the device."""

from __future__ import annotations

import torch
from torch import Tensor

FACTOR = 1.5  # of a change; that of rsl_rl and the default of TorchRL's KLAdaptiveLR


class KLAdaptiveRate:
    """The rule of :class:`torchrl.objectives.KLAdaptiveLR`, without a wait for the device.

    Attributes: ``target`` (), the mean KL divergence that is wanted, to be changed in place.

    Args: rate: () float32, changed in place; lowest, highest: its bounds.
    """

    def __init__(self, rate: Tensor, lowest: float, highest: float) -> None:
        self._rate, self._lowest, self._highest = rate, lowest, highest
        self.target = torch.zeros_like(rate)

    def begin_at(self, rate: float) -> None:
        """The rate of the next step."""
        self._rate.fill_(rate)

    def adapt(self, kl: Tensor) -> None:
        """Lower the rate if ``kl`` () is more than twice the target; raise it if ``kl`` is positive and less than half
        of it. A ``kl`` that is not finite is not judged here."""
        lower, raise_ = kl > 2.0 * self.target, (kl > 0.0) & (kl < 0.5 * self.target)
        factor = torch.where(lower, 1.0 / FACTOR, torch.where(raise_, FACTOR, 1.0))
        self._rate.mul_(factor).clamp_(self._lowest, self._highest)
