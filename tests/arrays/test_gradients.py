"""Gradients in one buffer are those that autograd computes, and stay where they are."""

from __future__ import annotations

import torch
from torch import nn

from pace.arrays.gradients import Gradients


def test_gradients_are_accumulated_in_the_buffer() -> None:
    torch.manual_seed(0)
    first, second = nn.Linear(3, 2), nn.Linear(2, 1)
    x = torch.randn(5, 3)
    plain = torch.autograd.grad(second(first(x)).sum(), [*first.parameters(), *second.parameters()])
    gradients = Gradients(list(first.parameters()), list(second.parameters()))
    gradients.hold()
    of_first, of_second = gradients.parts
    assert (len(gradients.flat), len(of_first), len(of_second)) == (12, 9, 3)
    for _ in range(2):
        gradients.flat.fill_(7.0)
        gradients.zero_()
        second(first(x)).sum().backward()
        gradients.first.fill_(0.5)
        torch.testing.assert_close(gradients.flat, torch.cat([torch.tensor([0.5]), *(g.flatten() for g in plain)]))
    for parameter in [*first.parameters(), *second.parameters()]:
        assert parameter.grad is not None
        assert parameter.grad.untyped_storage().data_ptr() == gradients.flat.untyped_storage().data_ptr()


def test_without_a_buffer_they_are_made_again_each_time() -> None:
    torch.manual_seed(0)
    network, x = nn.Linear(3, 2), torch.randn(5, 3)
    gradients, made = Gradients(list(network.parameters())), []
    for _ in range(2):
        gradients.zero_()
        network(x).sum().backward()
        made.append(network.weight.grad)
    assert made[0] is not made[1]
    torch.testing.assert_close(made[0], made[1])
    assert not gradients.flat.any()
