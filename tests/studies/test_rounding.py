"""What the KL divergence of an update measures: on a linear network, whose shift is known."""

from __future__ import annotations

import torch

from pace.rl.agent import MLP
from pace.studies import rounding


def test_a_shift_is_that_of_the_weights_and_in_bf16_mostly_rounding() -> None:
    torch.manual_seed(4)
    inputs, move = 64, 1e-5
    mlp = MLP(inputs, [], 3, 1.0, torch.float32)
    states = torch.randn(4000, inputs).bfloat16().float()  # as they are stored in either format
    before = [weight.clone() for weight in mlp.parameters()]
    bf16, fp32 = rounding.shifts(mlp, states, move).tolist()
    # each of 3 outputs moves by the sum of 64 inputs and 1 bias, each of variance one, with random signs
    assert 0.9 < fp32 / (3 * (inputs + 1) * move**2) < 1.1
    assert bf16 > 10 * fp32
    assert mlp.dtype == torch.float32
    assert all(torch.equal(a, b) for a, b in zip(before, mlp.parameters(), strict=True))


def test_kl_is_that_of_two_gaussians_and_the_table_has_a_row_for_each_std() -> None:
    found = rounding.Rounding("made up", torch.tensor([[2e-3, 2e-5]] * len(rounding.MOVES)))
    shift = torch.distributions.Normal(torch.tensor([2e-3]).sqrt(), 0.1), torch.distributions.Normal(0.0, 0.1)
    torch.testing.assert_close(found.kl(0.1)[0, 0], torch.distributions.kl_divergence(*shift).squeeze())
    assert rounding.table(found).splitlines()[2].startswith("| 0.5 | 0.004 / 4e-05 |")
