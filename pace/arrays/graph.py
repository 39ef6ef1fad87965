"""Work that repeats in every step, launched as one: CUDA graphs on a GPU, Warp's graphs on its CPU device."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from functools import cache
from typing import ClassVar

import torch
import warp as wp
from torch import Tensor

from pace.arrays.dry import Recording
from pace.arrays.streams import warp_stream
from pace.config.base import ConfigError
from pace.config.sim import EngineConfig


class Graphs(Enum):
    """How calls are captured: not at all, as CUDA graphs, or on a CPU as a :class:`pace.arrays.dry.Recording`."""

    NONE = "none"
    CUDA = "cuda"
    DRY = "dry"


def graphs_of(engine: EngineConfig, device: torch.device) -> Graphs:
    """How work on ``device`` is captured.

    Errors: :class:`ConfigError` for ``always`` on a CPU, and for ``dry`` on a GPU or with an engine that has no graphs.
    """
    if engine.graph == "always" and device.type != "cuda":
        raise ConfigError(f"engine.graph=always needs a GPU, and the device is {device}: use engine.graph=auto")
    if engine.graph == "dry":
        if device.type != "cpu":
            raise ConfigError("engine.graph=dry goes a GPU's way on a CPU: give device=cpu, or engine.graph=auto")
        if engine.name == "native":
            raise ConfigError("engine.graph=dry takes a GPU's engine: give engine=mjwarp, or engine.graph=auto")
        return Graphs.DRY
    return Graphs.CUDA if engine.graph != "never" and device.type == "cuda" else Graphs.NONE


class CapturedCall:
    """A function of tensors that works in place, replayed as a CUDA graph, or as a recording that stands for one.

    The first call runs the function as it is, which compiles kernels and binds tensors; the second captures it; from
    then on a call copies its arguments into fixed tensors and launches the graph, without any of the function's Python.
    So the function must do the same work on the same memory each time: no new value from Python, no copy from the
    host, no wait. It may compute gradients, if their tensors are allocated before. A call inside that of another
    :class:`CapturedCall` becomes part of the other.

    A graph knows its memory by address alone: let the owner of the tensors hold the call, or bind it to them
    (:class:`pace.arrays.launch.Bound`), so that it does not outlive them.

    Args:
        function: what is called; it returns nothing.
        device: where all of it runs.
        graphs: ``NONE``: every call is the function itself.
        generator: the source of its random numbers, besides torch's own of the device; each launch continues the
            sequence, as without a graph.

    Errors of the second call: ``RuntimeError`` for a function that cannot be captured.
    """

    _running: ClassVar[bool] = False

    def __init__(
        self,
        function: Callable[..., None],
        device: torch.device,
        graphs: Graphs,
        generator: torch.Generator | None = None,
    ) -> None:
        self._function, self._device, self._graphs, self._generator = function, device, graphs, generator
        self._inputs: tuple[Tensor, ...] | None = None
        self._graph: torch.cuda.CUDAGraph | Recording | None = None
        self._warp_graph: wp.Graph | None = None  # keeps the modules of Warp's kernels loaded

    def __call__(self, *values: Tensor) -> None:
        if self._graphs is Graphs.NONE or CapturedCall._running:
            self._function(*values)
        elif self._inputs is None:
            self._inputs = tuple(value.clone(memory_format=torch.contiguous_format) for value in values)
            with _as_one():
                self._warm_up(self._inputs)
        else:
            for own, value in zip(self._inputs, values, strict=True):
                own.copy_(value)
            with _as_one():
                if self._graph is None:
                    self._graph = self._capture(self._inputs)
                self._graph.replay()

    def _warm_up(self, inputs: tuple[Tensor, ...]) -> None:
        """The function as it is, on the stream of the capture: autograd binds gradients to the stream of their first
        use, and work on the default stream cannot be captured."""
        if self._graphs is Graphs.DRY:
            self._function(*inputs)
            return
        here, side = torch.cuda.current_stream(self._device), side_stream(self._device)
        side.wait_stream(here)
        with torch.cuda.stream(side), wp.ScopedStream(warp_stream(self._device, side.cuda_stream)):
            self._function(*inputs)
        here.wait_stream(side)

    def _capture(self, inputs: tuple[Tensor, ...]) -> torch.cuda.CUDAGraph | Recording:
        """The graph of one call. Nothing runs during the capture; Warp must know of it because it allocates memory."""
        if self._graphs is Graphs.DRY:
            return Recording(self._function, inputs)
        graph = torch.cuda.CUDAGraph()
        if self._generator is not None:
            graph.register_generator_state(self._generator)
        side = side_stream(self._device)
        warp_side = warp_stream(self._device, side.cuda_stream)
        try:
            with (
                _generators_kept(self._device, self._generator),
                torch.cuda.device(self._device),
                torch.cuda.stream(side),  # a failed capture does not leave its stream by itself
                wp.ScopedStream(warp_side),
                torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"),
                wp.ScopedCapture(stream=warp_side, external=True) as capture,
            ):
                self._function(*inputs)
        except RuntimeError as error:
            raise RuntimeError(f"no CUDA graph of {self._function}; engine.graph=never runs without graphs") from error
        self._warp_graph = capture.graph
        return graph


@cache
def side_stream(device: torch.device) -> torch.cuda.Stream:
    """The stream of warm-ups and captures on a GPU: torch's default stream cannot be captured."""
    return torch.cuda.Stream(device)


@contextmanager
def _generators_kept(device: torch.device, generator: torch.Generator | None) -> Iterator[None]:
    """Within it a capture may fail: torch 2.11 then leaves its generators as if it went on, and they refuse to work."""
    default = torch.cuda.default_generators[device.index or 0]
    used = [default] if generator is None else [default, generator]
    before = [each.clone_state() for each in used]
    try:
        yield
    except RuntimeError:
        for each, state in zip(used, before, strict=True):
            each.graphsafe_set_state(state)
        raise


def may_look(values: Tensor) -> bool:
    """Whether the host may read ``values`` without a wait: on a CPU, and not within what a graph could hold."""
    return values.device.type == "cpu" and not CapturedCall._running


class RecordedLaunches:
    """Launches on Warp's CPU device, repeated in C++ if ``enabled``: Python is a quarter of a step of 256 robots.

    As with :class:`CapturedCall`, the first call runs the function and the second records it, and the function must do
    the same each time. Here it may only launch Warp kernels. A loop that ends on a condition is recorded as such.
    """

    def __init__(self, function: Callable[[], None], enabled: bool) -> None:
        self._function, self._enabled = function, enabled
        self._compiled = False
        self._graph: wp.Graph | None = None

    def __call__(self) -> None:
        if not self._enabled or CapturedCall._running or not self._compiled:
            self._function()
            self._compiled = True
            return
        if self._graph is None:
            with wp.ScopedCapture(device="cpu") as capture:  # records, and runs nothing
                self._function()
            self._graph = capture.graph
        wp.capture_launch(self._graph)


@contextmanager
def _as_one() -> Iterator[None]:
    """Nested calls become part of the outer call."""
    CapturedCall._running = True
    try:
        yield
    finally:
        CapturedCall._running = False
