"""A step and a reset as graphs do what they do without, on a CPU in a dry run; tests/gpu has CUDA's."""

from __future__ import annotations

import gc
from typing import Any

import pytest
import torch
import warp as wp
from torch import Tensor

from pace.arrays import graph
from pace.arrays.graph import CapturedCall, Graphs, graphs_of, may_look
from pace.arrays.watch import DryRunError, loads_refused
from pace.config.base import ConfigError
from pace.task.env import TableTennisEnv
from tests.helpers.emulation import without_replay
from tests.helpers.fakes import config
from tests.helpers.playing import STEPS, N, make, play


def captured(function: Any) -> CapturedCall:
    return CapturedCall(function, torch.device("cpu"), Graphs.DRY)


def test_a_call_is_replayed_with_new_arguments_and_new_random_draws() -> None:
    total, drawn = torch.zeros(3), torch.zeros(3)
    generator = torch.Generator().manual_seed(3)
    expected = torch.rand(4, 3, generator=torch.Generator().manual_seed(3))

    def function(value: Tensor) -> None:
        drawn.copy_(torch.rand(3, generator=generator))
        total[1:] += (2.0 * value)[1:]

    call = captured(function)
    for k in range(4):
        call(torch.full((3,), float(k)))
        torch.testing.assert_close(drawn, expected[k], rtol=0, atol=0)
    assert total.tolist() == [0.0, 12.0, 12.0]  # 2 (0 + 1 + 2 + 3)


def test_a_call_within_another_is_part_of_it() -> None:
    count = torch.zeros(())
    inner = captured(lambda: count.add_(1.0))
    outer = captured(lambda: inner())
    for _ in range(5):
        outer()
    assert count == 5.0
    assert outer._graph is not None
    assert inner._graph is None


def test_the_host_may_look_outside_of_what_a_graph_could_hold() -> None:
    mask, seen = torch.ones(2, dtype=torch.bool), []
    captured(lambda: seen.append(may_look(mask)))()
    CapturedCall(lambda: seen.append(may_look(mask)), torch.device("cpu"), Graphs.NONE)()
    assert seen == [False, True]
    assert not may_look(mask.to("meta"))


@pytest.mark.slow
def test_replayed_steps_and_resets_equal_those_without_a_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit, though a replay has nothing but the operators, numbers and addresses of the second call."""

    def played() -> tuple[TableTennisEnv, list[dict[str, Any]]]:
        env = make("cpu", "engine.graph=dry")
        states = play(env, 5)
        env.warmup_serves = 2
        return env, states + play(env)

    graphed, states = played()
    assert graphed._step_in_place._graph is not None
    without_replay(monkeypatch)
    plain, expected = played()
    for step, (state, other) in enumerate(zip(states, expected, strict=True)):
        for name, value in other.items():
            torch.testing.assert_close(
                state[name], value, rtol=0, atol=0, equal_nan=True, msg=lambda text, k=step, n=name: f"{n}, {k}: {text}"
            )
    statistics, same = graphed.pop_statistics(), plain.pop_statistics()
    assert statistics == same
    assert min(statistics["episodes"], statistics["serves"]) > 0
    assert statistics["steps"] == N * (STEPS + 5)


@pytest.mark.parametrize("graphs", ["auto", "dry"])
def test_a_second_environment_leaves_the_first_one_as_it_is(graphs: str) -> None:
    """As in a notebook: another is made, played and freed while the first one goes on."""

    def played(beside: bool) -> list[dict[str, Any]]:
        env = make("cpu", f"engine.graph={graphs}")
        states = play(env, 4)
        if beside:
            other = make("cpu", f"engine.graph={graphs}", "robot.action_scale=0.3")
            play(other, 4)
            states += play(env, 2)
            del other
            gc.collect()
            return states + play(env, 2)
        return states + play(env, 2) + play(env, 2)

    for state, same in zip(played(True), played(False), strict=True):
        for name, value in same.items():
            torch.testing.assert_close(state[name], value, rtol=0, atol=0, equal_nan=True)


def test_graphs_need_a_gpu() -> None:
    with pytest.raises(ConfigError, match=r"engine\.graph=always needs a GPU, and the device is cpu"):
        make("cpu", "engine.graph=always")
    with pytest.raises(ConfigError, match=r"engine\.graph must be auto, always, never or dry, not 'on'"):
        config("engine.graph='on'")
    with pytest.raises(ConfigError, match=r"engine\.graph=dry takes a GPU's engine: give engine=mjwarp, or"):
        make("cpu", "engine=native", "engine.graph=dry")
    with pytest.raises(ConfigError, match=r"engine\.graph=dry goes a GPU's way on a CPU: give device=cpu"):
        graphs_of(config("engine.graph=dry").engine, torch.device("cuda"))


class Uncapturable:
    """In place of a CUDA graph: the function runs half, takes random numbers, and the driver gives up."""

    reason = "CUDA error: operation not permitted when stream is capturing"

    def __init__(self, function: Any, inputs: Any, device: Any, generator: torch.Generator) -> None:
        torch.rand(3)
        torch.rand(3, generator=generator)
        try:
            raise RuntimeError(f"{self.reason}\nCUDA kernel errors might be asynchronously reported")
        finally:
            raise RuntimeError("CUDA error: the capture was ended before")  # what its end says, behind the first error


def drawing(total: Tensor, generator: torch.Generator) -> Any:
    def add_numbers(scale: Tensor) -> None:
        total.add_(scale * torch.rand(3, generator=generator) + torch.rand(3))

    return add_numbers


def drawn(graphs: Graphs, calls: int = 5) -> Tensor:
    torch.manual_seed(4)
    total, generator = torch.zeros(3), torch.Generator().manual_seed(3)
    call = CapturedCall(drawing(total, generator), torch.device("cpu"), graphs, generator)
    for k in range(calls):
        call(torch.full((3,), float(k)))
    return torch.cat([total, torch.rand(1), torch.rand(1, generator=generator)])


def test_without_a_capture_it_goes_on_as_before_and_says_so_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(graph, "CudaGraph", Uncapturable)
    graph._SAID.clear()
    expected = drawn(Graphs.NONE)
    assert capsys.readouterr().err == ""
    for _ in range(2):
        assert torch.equal(drawn(Graphs.TRY), expected)
    assert capsys.readouterr().err == (
        "warning: no CUDA graphs, so it is slower (drawing.<locals>.add_numbers cannot be captured: "
        f"{Uncapturable.reason}); engine.graph=always makes it an error\n"
    )
    with pytest.raises(RuntimeError, match=r"no CUDA graph, .*add_numbers cannot be captured: .*engine\.graph=never"):
        drawn(Graphs.CUDA)


def test_a_part_of_what_cannot_be_captured_still_can(monkeypatch: pytest.MonkeyPatch) -> None:
    class OnlyInner:
        def __init__(self, function: Any, inputs: Any, *_: Any) -> None:
            if function is outer_function:
                raise RuntimeError("too large")
            self.replay = function

    count = torch.zeros(())

    def add_one() -> None:
        count.add_(1.0)

    def outer_function() -> None:
        inner()

    inner = CapturedCall(add_one, torch.device("cpu"), Graphs.TRY)
    outer = CapturedCall(outer_function, torch.device("cpu"), Graphs.TRY)
    monkeypatch.setattr(graph, "CudaGraph", OnlyInner)
    for _ in range(5):
        outer()
    assert count == 5.0
    assert outer._graph is None
    assert isinstance(inner._graph, OnlyInner)


def test_a_full_memory_is_no_reason_to_go_on_without(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def __init__(self, *_: Any) -> None:
            raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(graph, "CudaGraph", Full)
    with pytest.raises(torch.OutOfMemoryError):
        drawn(Graphs.TRY)


def test_a_gpu_without_a_memory_pool(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(graph, "memory_pool_is_off", lambda _: True)
    graph._SAID.clear()
    gpu = torch.device("cuda:0")
    for _ in range(2):
        assert graphs_of(config().engine, gpu) is Graphs.NONE
    said = capsys.readouterr().err
    assert said.count("warning: no CUDA graphs, so it is slower (the memory pool of cuda:0 is off") == 1
    with pytest.raises(
        ConfigError, match=r"engine\.graph=always: the memory pool of cuda:0 is off.*graph=auto goes on"
    ):
        graphs_of(config("engine.graph=always").engine, gpu)
    monkeypatch.setattr(graph, "memory_pool_is_off", lambda _: False)
    assert graphs_of(config().engine, gpu) is Graphs.TRY
    assert graphs_of(config("engine.graph=always").engine, gpu) is Graphs.CUDA
    assert graphs_of(config("engine.graph=never").engine, gpu) is Graphs.NONE


@wp.kernel(module=wp.get_module("tests.graph.first"))
def first_used(x: wp.array[float]):
    x[wp.tid()] = 1.0


def test_a_kernel_that_is_first_used_in_a_capture_is_named() -> None:
    x = wp.zeros(2, dtype=float, device="cpu")
    with loads_refused(), pytest.raises(DryRunError, match=r"kernel 'first_used' is used for the first time"):
        wp.launch(first_used, dim=2, inputs=[x], device="cpu")
    wp.launch(first_used, dim=2, inputs=[x], device="cpu")
    with loads_refused():
        wp.launch(first_used, dim=2, inputs=[x], device="cpu")
        first_used.module.unload()  # as by another library
        with pytest.raises(DryRunError, match=r"kernel 'first_used' is .* or was unloaded: Warp's module tests\.graph"):
            wp.launch(first_used, dim=2, inputs=[x], device="cpu")
