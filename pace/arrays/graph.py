"""Work that repeats in every step, launched as one: CUDA graphs on a GPU, Warp's graphs on its CPU device."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ClassVar

import torch
import warp as wp
from torch import Tensor

from pace.arrays.streams import warp_stream
from pace.config.base import ConfigError
from pace.config.sim import EngineConfig


def graphs_wanted(engine: EngineConfig, device: torch.device) -> bool:
    """Whether steps and resets on ``device`` are captured. Errors: :class:`ConfigError` for ``always`` on a CPU."""
    if engine.graph == "always" and device.type != "cuda":
        raise ConfigError(f"engine.graph=always needs a GPU, and the device is {device}: use engine.graph=auto")
    return engine.graph != "never" and device.type == "cuda"


class CapturedCall:
    """A function of tensors that works in place, replayed as a CUDA graph if ``enabled``.

    The first call runs the function as it is, which compiles kernels and binds tensors; the second captures it; from
    then on a call copies its arguments into fixed tensors and launches the graph, without any of the function's Python.
    So the function must do the same work on the same memory each time: no new value from Python, no copy from the
    host, no wait. A call inside that of another :class:`CapturedCall` becomes part of the other.

    Args:
        function: what is called; it returns nothing.
        device: where all of it runs.
        enabled: off: every call is the function itself.
        generator: the source of its random numbers; each launch continues the sequence, as without a graph.

    Errors of the second call: ``RuntimeError`` for a function that cannot be captured.
    """

    _running: ClassVar[bool] = False

    def __init__(
        self,
        function: Callable[..., None],
        device: torch.device,
        enabled: bool,
        generator: torch.Generator | None = None,
    ) -> None:
        self._function, self._device, self._enabled, self._generator = function, device, enabled, generator
        self._inputs: tuple[Tensor, ...] | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._warp_graph: wp.Graph | None = None  # keeps the modules of Warp's kernels loaded

    def __call__(self, *values: Tensor) -> None:
        if not self._enabled or CapturedCall._running:
            self._function(*values)
        elif self._inputs is None:
            self._inputs = tuple(value.clone(memory_format=torch.contiguous_format) for value in values)
            with _as_one():
                self._function(*self._inputs)
        else:
            for own, value in zip(self._inputs, values, strict=True):
                own.copy_(value)
            if self._graph is None:
                with _as_one():
                    self._graph = self._capture(self._inputs)
            self._graph.replay()

    def _capture(self, inputs: tuple[Tensor, ...]) -> torch.cuda.CUDAGraph:
        """The graph of one call. Nothing runs during the capture; Warp must know of it because it allocates memory."""
        graph = torch.cuda.CUDAGraph()
        if self._generator is not None:
            graph.register_generator_state(self._generator)
        side = torch.cuda.Stream(self._device)  # torch's default stream cannot be captured
        warp_side = warp_stream(self._device, side.cuda_stream)
        try:
            with (
                torch.cuda.device(self._device),
                wp.ScopedStream(warp_side),
                torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"),
                wp.ScopedCapture(stream=warp_side, external=True) as capture,
            ):
                self._function(*inputs)
        except RuntimeError as error:
            raise RuntimeError(f"no CUDA graph of {self._function}; engine.graph=never runs without graphs") from error
        self._warp_graph = capture.graph
        return graph


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
