"""Warp's part of a dry run: its launches, copies and memory on its CPU device."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp
from warp._src import context

from pace.arrays.steps import Comparer, Step, given
from pace.arrays.watch import DryRunError, place, replaced

CTYPES = (ctypes.Structure, ctypes.Array, ctypes._SimpleCData)
#: All launches on a CPU pass one of these.
LAUNCHES = ("invoke", "invoke_cpu_blocks")
#: What works on arrays without a launch.
FUNCTIONS: tuple[tuple[Any, str], ...] = (
    (wp, "copy"),
    (context, "copy"),
    (wp.array, "zero_"),
    (wp.array, "fill_"),
    (wp.utils, "array_scan"),
    (wp.utils, "radix_sort_pairs"),
    (wp.utils, "segmented_sort_pairs"),
)
#: What knows the arrays of a launch, which its arguments name by address alone.
OWNERS: tuple[tuple[Any, str], ...] = ((wp, "launch"), (context, "launch"), (context.Launch, "launch"))

See = Callable[[str, Any, Callable[[], object]], None]


class WarpWork:
    """What Warp does within a call, recorded or compared. The memory that it takes stays where it was recorded."""

    def __init__(self) -> None:
        self._memory, self._kept, self._inside = _Memory(), [], False

    @contextmanager
    def recording(self, steps: list[Step]) -> Iterator[None]:
        """Within it, work is done and appended to ``steps``."""

        def see(name: str, arguments: Any, work: Callable[[], object]) -> None:
            steps.append(Step(name, place(), arguments, work))
            work()

        owners = [(owner, name, self._keeping(getattr(owner, name))) for owner, name in OWNERS]
        with self._seen_by(see), replaced(*owners):
            yield

    @contextmanager
    def comparing(self, comparer: Comparer) -> Iterator[None]:
        """Within it, work is not done, but compared."""

        def see(name: str, arguments: Any, work: Callable[[], object]) -> None:
            comparer(name, arguments)

        self._memory.begin_again()
        with self._seen_by(see):
            yield

    @contextmanager
    def _seen_by(self, see: See) -> Iterator[None]:
        launches = [(context, name, self._launching(getattr(context, name), see)) for name in LAUNCHES]
        functions = [(owner, name, self._calling(name, getattr(owner, name), see)) for owner, name in FUNCTIONS]
        allocator = (wp.get_device("cpu"), "default_allocator", self._memory)
        with replaced(*launches, *functions, allocator):
            yield

    def _launching(self, invoke: Any, see: See) -> Any:
        def launch(kernel: Any, hooks: Any, params: Any, adjoint: bool) -> None:
            if self._inside:
                invoke(kernel, hooks, params, adjoint)
                return
            kept = [type(value).from_buffer_copy(value) if isinstance(value, CTYPES) else value for value in params]
            names = ("the number of threads", *(argument.label for argument in kernel.adj.args))
            arguments = dict(zip(names, map(_plain, kept), strict=False))
            see(f"kernel {kernel.key}", arguments, lambda: invoke(kernel, hooks, kept, adjoint))

        return launch

    def _calling(self, name: str, function: Any, see: See) -> Any:
        def call(*args: Any, **kwargs: Any) -> None:
            if self._inside:  # a part of another one
                function(*args, **kwargs)
                return

            def work() -> None:
                self._inside = True
                try:
                    function(*args, **kwargs)
                finally:
                    self._inside = False

            see(f"warp.{name}", given((args, kwargs)), work)

        return call

    def _keeping(self, function: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            self._kept.append((args, kwargs))
            return function(*args, **kwargs)

        return call


def _plain(value: Any) -> Any:
    """An argument of a launch, to be compared."""
    if isinstance(value, ctypes._SimpleCData):
        return value.value
    return bytes(value) if isinstance(value, CTYPES) else value


class _Memory:
    """Warp's memory of one call: allocated once, and handed out again in the same order to later calls."""

    deallocate_requires_context_guard = False
    memory_kind = context.MemoryKind.HOST

    def __init__(self) -> None:
        self._source = wp.get_device("cpu").default_allocator
        self._blocks: list[tuple[int, int]] = []  # address, bytes
        self._next: int | None = None  # None: new blocks

    def begin_again(self) -> None:
        """From now on hand out the known blocks, from the first one."""
        self._next = 0

    def allocate(self, size: int) -> int:
        """Address of ``size`` bytes. Errors: :class:`DryRunError` if later calls need other memory."""
        if self._next is None:
            self._blocks.append((self._source.allocate(size), size))
            return self._blocks[-1][0]
        if self._next >= len(self._blocks) or self._blocks[self._next][1] != size:
            raise DryRunError(f"{place()}: Warp allocates {size} bytes, which the recorded call did not")
        self._next += 1
        return self._blocks[self._next - 1][0]

    def deallocate(self, address: int, size: int) -> None:
        """Nothing: the memory belongs to the recording, and to its last array."""

    def __del__(self) -> None:
        for block in self._blocks:
            self._source.deallocate(*block)
