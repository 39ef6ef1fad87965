"""The learning rate on the device follows TorchRL's rule."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.objectives import KLAdaptiveLR

from pace.rl.adaptive_rate import KLAdaptiveRate


def test_it_is_the_rule_of_torchrl() -> None:
    parameter = torch.nn.Parameter(torch.zeros(1))
    theirs = KLAdaptiveLR(torch.optim.Adam([parameter], lr=1e-3), 0.02, min_lr=1e-4, max_lr=4e-3)
    rate = torch.tensor(1e-3)
    ours = KLAdaptiveRate(rate, 1e-4, 4e-3)
    ours.target.fill_(0.02)
    for kl in (0.02, 0.041, 0.039, 0.0, 0.009, 0.011, *[0.001] * 5, -0.001, *[1.0] * 12, 0.02):
        theirs.step(kl)
        ours.adapt(torch.tensor(kl))
        assert rate.item() == pytest.approx(theirs.get_last_lr()[0], rel=1e-5)


@pytest.mark.parametrize("kl", [math.nan, -math.inf])
def test_what_is_not_finite_does_not_move_it(kl: float) -> None:
    rate = torch.tensor(1e-3)
    rule = KLAdaptiveRate(rate, 1e-5, 1e-2)
    rule.target.fill_(0.02)
    rule.adapt(torch.tensor(kl))
    assert rate == torch.tensor(1e-3)
