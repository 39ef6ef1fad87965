"""An optimiser resumes in place: its learning rate and its moments stay the tensors that others know."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from pace.runs.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from pace.runs.optimiser import adam, learning_rate, load_optimiser_state, optimiser_state


def stepped(steps: int) -> tuple[nn.Linear, torch.optim.Adam]:
    torch.manual_seed(0)
    network = nn.Linear(3, 2)
    optimiser = adam(list(network.parameters()), 1e-3)
    for _ in range(steps):
        optimiser.zero_grad()
        network(torch.ones(1, 3)).square().sum().backward()
        optimiser.step()
    return network, optimiser


def tensors(optimiser: torch.optim.Adam) -> Iterator[Tensor]:
    yield learning_rate(optimiser)
    for entry in optimiser.state.values():
        yield from entry.values()


def test_a_learning_rate_that_is_steered_stays_the_same_tensor() -> None:
    _, optimiser = stepped(3)
    learning_rate(optimiser).fill_(5e-4)
    saved = optimiser_state(optimiser)
    assert saved["lr"] == 5e-4
    assert isinstance(saved["lr"], float)
    _, other = stepped(0)
    steered = learning_rate(other)
    load_optimiser_state(other, saved)
    assert learning_rate(other) is steered
    assert steered == torch.tensor(5e-4)


def test_moments_that_a_graph_knows_stay_the_same_tensors() -> None:
    _, optimiser = stepped(3)
    _, other = stepped(5)
    before = list(tensors(other))
    load_optimiser_state(other, optimiser_state(optimiser))
    after = list(tensors(other))
    assert all(new is old for new, old in zip(after, before, strict=True))
    assert all(torch.equal(new, old) for new, old in zip(after, tensors(optimiser), strict=True))
    load_optimiser_state(other, optimiser_state(stepped(0)[1]))
    assert all(new is old for new, old in zip(tensors(other), before, strict=True))
    assert all(not tensor.any() for tensor in before[1:])


def test_the_file_holds_a_number_and_older_ones_are_read(tmp_path: Path) -> None:
    _, optimiser = stepped(2)
    learning_rate(optimiser).mul_(1.5)
    checkpoint = Checkpoint({}, {}, {}, {"algorithm": optimiser_state(optimiser)})
    training = load_checkpoint(save_checkpoint(tmp_path / "update_1", checkpoint)).training
    assert training is not None
    assert training["algorithm"]["lr"] == 0.0015
    plain = torch.optim.Adam(nn.Linear(3, 2).parameters(), lr=1.0)  # a learning rate that is a number is one afterwards
    load_optimiser_state(plain, training["algorithm"])
    assert plain.param_groups[0]["lr"] == 0.0015
