"""A step and a reset as CUDA graphs do what they do without; tests/arrays/test_graph.py has the dry run of a CPU."""

from __future__ import annotations

import pytest
import torch
import warp as wp
from torch import Tensor

from pace.arrays.graph import CapturedCall, CudaGraph, Graphs
from pace.arrays.launch import Launch
from tests.helpers.playing import make, play

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="captures CUDA graphs"),
]


@wp.kernel
def _add(values: wp.array[float], total: wp.array[float]):
    total[wp.tid()] += values[wp.tid()]


def test_a_cuda_graph_holds_torchs_and_warps_work() -> None:
    device = torch.device("cuda:0")
    generator, same = (torch.Generator(device).manual_seed(3) for _ in range(2))
    drawn, total = torch.zeros(8, device=device), torch.zeros(8, device=device)
    add = Launch(_add, 8, device, total=total, values=drawn)

    def function(scale: Tensor) -> None:
        drawn.copy_(scale * torch.rand(8, device=device, generator=generator))
        add()

    call = CapturedCall(function, device, Graphs.CUDA, generator)
    expected = torch.zeros(8, device=device)
    for k in range(6):
        call(torch.full((8,), float(k), device=device))
        expected += float(k) * torch.rand(8, device=device, generator=same)
    assert isinstance(call._graph, CudaGraph)
    torch.testing.assert_close(total, expected)
    assert torch.equal(generator.get_state(), same.get_state())


def test_cuda_graphs_of_step_and_reset_do_what_the_calls_do() -> None:
    """The draws are the same to the bit; motion up to what MuJoCo Warp's order of summation on a GPU leaves open."""
    plain, graphed = make("cuda", "engine.graph=never"), make("cuda", "engine.graph=always")
    expected, states = play(plain), play(graphed)
    for call in (graphed._step_in_place, graphed._reset_in_place):
        assert isinstance(call._graph, CudaGraph)
    for state, other in zip(states, expected, strict=True):
        assert torch.equal(state["generator"], other["generator"])
    for name in ("policy.observation", "rewards.reward", "worlds.position", "worlds.drawn.actuator_delay"):
        first, second = (torch.stack([state[name] for state in played[:10]]) for played in (states, expected))
        assert (first - second).abs().median() < 1e-3
    assert not graphed.worlds.engine.overflowed()
