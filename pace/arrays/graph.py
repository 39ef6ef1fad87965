"""Work that repeats in every step, launched as one: CUDA graphs on a GPU, Warp's graphs on its CPU device."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from functools import cache, partial
from typing import Any, ClassVar

import torch
import warp as wp
from torch import Tensor

from pace.arrays.dry import Recording
from pace.arrays.streams import warp_stream
from pace.arrays.watch import loads_refused
from pace.config.base import ConfigError
from pace.config.sim import EngineConfig
from pace.devices import memory_pool_is_off, out_of_memory


class Graphs(Enum):
    """How calls are captured: not at all; as CUDA graphs, with an error for what cannot be captured, or (``TRY``) with
    a line, after which it is called as it is; or on a CPU as a :class:`pace.arrays.dry.Recording`."""

    NONE = "none"
    CUDA = "cuda"
    TRY = "try"
    DRY = "dry"


def graphs_of(engine: EngineConfig, device: torch.device) -> Graphs:
    """How work on ``device`` is captured.

    A GPU whose memory pool is off cannot capture: ``auto`` then says so once, and goes on without graphs.

    Errors: :class:`ConfigError` for ``always`` on a CPU or such a GPU, and for ``dry`` on a GPU or with an engine that
    has no graphs.
    """
    if engine.graph == "always" and device.type != "cuda":
        raise ConfigError(f"engine.graph=always needs a GPU, and the device is {device}: use engine.graph=auto")
    if engine.graph == "dry":
        if device.type != "cpu":
            raise ConfigError("engine.graph=dry goes a GPU's way on a CPU: give device=cpu, or engine.graph=auto")
        if engine.name == "native":
            raise ConfigError("engine.graph=dry takes a GPU's engine: give engine=mjwarp, or engine.graph=auto")
        return Graphs.DRY
    if engine.graph == "never" or device.type != "cuda":
        return Graphs.NONE
    if memory_pool_is_off(device):
        reason = f"the memory pool of {device} is off, as Warp says"
        if engine.graph == "always":
            raise ConfigError(f"engine.graph=always: {reason}; engine.graph=auto goes on without graphs")
        _say_without_graphs(reason)
        return Graphs.NONE
    return Graphs.CUDA if engine.graph == "always" else Graphs.TRY


_SAID: set[str] = set()  # reasons


def _say_without_graphs(reason: str, what: str = "") -> None:
    """One line for each reason, with the first call that it stopped."""
    if reason not in _SAID:
        _SAID.add(reason)
        text = f"warning: no CUDA graphs, so it is slower ({what}{reason}); engine.graph=always makes it an error"
        print(text, file=sys.stderr)


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

    Errors of the second call: ``RuntimeError`` for a function that cannot be captured. With ``TRY`` it is said in one
    line instead, and this and all later calls are the function itself; those within it are then captured alone.
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
        self._graph: Recording | CudaGraph | None = None

    def __call__(self, *values: Tensor) -> None:
        if self._graphs is Graphs.NONE or CapturedCall._running:
            self._function(*values)
        elif self._inputs is None:
            self._inputs = tuple(value.clone(memory_format=torch.contiguous_format) for value in values)
            with as_one():
                self._warm_up(self._inputs)
        else:
            for own, value in zip(self._inputs, values, strict=True):
                own.copy_(value)
            with as_one():
                graph = self._graph = self._graph or self._capture(self._inputs)
                if graph is not None:
                    graph.replay()
            if graph is None:
                self._function(*values)

    def _warm_up(self, inputs: tuple[Tensor, ...]) -> None:
        """The function as it is, on the stream of the capture: autograd binds gradients to the stream of their first
        use, and work on the default stream cannot be captured."""
        if self._device.type == "cpu":
            self._function(*inputs)
            return
        here, side = torch.cuda.current_stream(self._device), side_stream(self._device)
        side.wait_stream(here)
        with torch.cuda.stream(side), wp.ScopedStream(warp_stream(self._device, side.cuda_stream)):
            self._function(*inputs)
        here.wait_stream(side)

    def _capture(self, inputs: tuple[Tensor, ...]) -> Recording | CudaGraph | None:
        """What replays the call; None if it cannot be captured, and from then on is called as it is."""
        if self._graphs is Graphs.DRY:
            return Recording(self._function, inputs)
        try:
            with _generators_kept(self._device, self._generator):
                return CudaGraph(self._function, inputs, self._device, self._generator)
        except RuntimeError as error:
            first = _first(error)
            if out_of_memory(first):
                raise
            what, reason = f"{_name(self._function)} cannot be captured: ", str(first).strip().splitlines()[0]
            if self._graphs is Graphs.CUDA:
                raise RuntimeError(f"no CUDA graph, {what}{reason}; engine.graph=never runs without graphs") from error
            _say_without_graphs(reason, what)
            self._graphs = Graphs.NONE
            return None


def _first(error: BaseException) -> BaseException:
    """What went wrong in a capture: its end fails then too, with an error that hides the first one."""
    while isinstance(error.__context__, RuntimeError):
        error = error.__context__
    return error


def _name(function: Any) -> str:
    while isinstance(function, partial):
        function = function.func
    return getattr(function, "__qualname__", type(function).__name__)


class CudaGraph:
    """A call of a function, captured on a GPU.

    Errors: ``RuntimeError`` for a function that cannot be captured; streams are then as before, and nothing has
    run. It names a kernel of Warp that is used for the first time, or was unloaded since the warm-up.
    """

    def __init__(
        self,
        function: Callable[..., None],
        inputs: tuple[Tensor, ...],
        device: torch.device,
        generator: torch.Generator | None,
    ) -> None:
        graph = self._graph = torch.cuda.CUDAGraph()
        if generator is not None:
            graph.register_generator_state(generator)
        side = side_stream(device)
        warp_side = warp_stream(device, side.cuda_stream)
        with (
            torch.cuda.device(device),
            torch.cuda.stream(side),  # a failed capture does not leave its stream by itself
            wp.ScopedStream(warp_side),
            torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"),
            wp.ScopedCapture(stream=warp_side, external=True) as capture,  # Warp allocates memory within
            loads_refused(),
        ):
            function(*inputs)
        self._warp_graph = capture.graph  # keeps the modules of Warp's kernels loaded

    def replay(self) -> None:
        """Do it again."""
        self._graph.replay()


@cache
def side_stream(device: torch.device) -> torch.cuda.Stream:
    """The stream of warm-ups and captures on a GPU: torch's default stream cannot be captured."""
    return torch.cuda.Stream(device)


@contextmanager
def _generators_kept(device: torch.device, generator: torch.Generator | None) -> Iterator[None]:
    """Within it a capture may fail: torch 2.11 then leaves its generators as if it went on, and they refuse to work."""
    on_gpu = device.type == "cuda"
    default = torch.cuda.default_generators[device.index or 0] if on_gpu else torch.default_generator
    used = [default] if generator is None else [default, generator]
    before = [each.clone_state() for each in used]
    try:
        yield
    except RuntimeError:
        for each, state in zip(used, before, strict=True):
            if on_gpu:
                each.graphsafe_set_state(state)
            else:
                each.set_state(state.get_state())
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
def as_one() -> Iterator[None]:
    """Nested calls become part of the outer call."""
    CapturedCall._running = True
    try:
        yield
    finally:
        CapturedCall._running = False
