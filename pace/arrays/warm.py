"""Warp's kernels of some work, found without doing it, and compiled side by side.

Many kernels are made while the work runs, for the sizes of a model: only a pass through it tells which modules it
needs. That pass is a rehearsal, in which nothing is launched and no module loaded. The modules are then whole, with all
versions of their kernels, and so is the hash by which Warp finds them again.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import warp as wp
from tqdm import tqdm
from warp._src import context

from pace.arrays.graph import as_one
from pace.arrays.watch import replaced

GPU_BLOCK = 256  # threads of a block unless a launch says otherwise: Warp's default on a GPU


class Wanted(NamedTuple):
    """A module that is loaded for blocks of so many threads."""

    module: Any
    block_dim: int


class Target(NamedTuple):
    """What to compile for: a ``device`` that is there, or else the architecture ``arch`` of a GPU (90: sm_90)."""

    device: Any = None
    arch: int | None = None


_rehearsals = 0  # that run now


def rehearsing() -> bool:
    """Whether launches are noted only: what waits for their results would wait for ever."""
    return _rehearsals > 0


class SilentLaunch:
    """In place of a recorded launch."""

    def launch(self, stream: Any = None) -> None:
        """Nothing."""


@contextmanager
def rehearsal(of_a_gpu: bool = False) -> Iterator[list[Wanted]]:
    """Within it, launches are noted, but not done, and arrays keep what they hold.

    ``of_a_gpu``: the work runs on a CPU, and a GPU's blocks are noted. Code that asks for the device itself is noted as
    it runs on a CPU. Yields the list of the modules in the order of their first launch.
    """
    found: list[Wanted] = []

    def note(module: Any, _device: Any, block_dim: int | None = None, **_: Any) -> None:
        """In place of ``Module.load``. A launch without a loaded module does nothing."""
        wanted = Wanted(module, int(block_dim or module.options["block_dim"]))
        if wanted not in found:
            found.append(wanted)

    def occupancy(kernel: wp.Kernel, device: Any = None) -> tuple[int, int]:
        """In place of ``wp.get_suggested_block_size``, which loads the module on a GPU, and nothing on a CPU."""
        if of_a_gpu or wp.get_device(device).is_cuda:
            note(kernel.module, device)
        return GPU_BLOCK, 1

    def once(_condition: Any, while_body: Callable[..., None], _stream: Any = None, **given: Any) -> None:
        while_body(**given)

    launch = context.launch

    def silent(*args: Any, **kwargs: Any) -> Any:
        launch(*args, **kwargs)
        return SilentLaunch() if kwargs.get("record_cmd") else None

    replacements: list[tuple[Any, str, Any]] = [
        (context.Module, "load", note),
        (context, "launch", silent),
        (wp, "launch", silent),
        (wp, "get_suggested_block_size", occupancy),
        (wp, "capture_while", once),
    ]
    if of_a_gpu:
        replacements.append((context, "_resolve_launch_block_dim", lambda _device, asked: int(asked or GPU_BLOCK)))
    global _rehearsals
    with replaced(*replacements), as_one():
        _rehearsals += 1
        try:
            yield found
        finally:
            _rehearsals -= 1


def missing(wanted: Sequence[Wanted], target: Target) -> list[Wanted]:
    """Those of ``wanted`` that Warp's folder of kernels does not hold for the ``target``."""
    return [each for each in wanted if not all(file.exists() for file in _files(each, target))]


def _files(wanted: Wanted, target: Target) -> tuple[Path, Path]:
    """Program and description of a module in Warp's folder of kernels."""
    module, block_dim = wanted
    folder = Path(str(wp.config.kernel_cache_dir)) / module.get_module_identifier(block_dim)
    program = module._get_compile_output_name(target.device, target.arch, block_dim=block_dim)
    return folder / program, folder / module._get_meta_name(block_dim=block_dim)


def compile_kernels(wanted: Sequence[Wanted], target: Target, workers: int) -> None:
    """Compile modules in ``workers`` threads, with a bar on a terminal. Warp's compilers run outside of Python's lock.

    Errors: those of Warp's compilers.
    """
    with ThreadPoolExecutor(workers) as pool, _bar(len(wanted)) as bar:
        for done in as_completed([pool.submit(_compile, each, target) for each in wanted]):
            done.result()
            bar.update()


def _compile(wanted: Wanted, target: Target) -> None:
    module, block_dim = wanted
    module.get_module_hash(block_dim)
    module._compile(target.device, output_arch=target.arch, options=module.resolved_options[block_dim])


def _bar(total: int) -> tqdm:
    return tqdm(total=total, unit="module", disable=not sys.stderr.isatty(), leave=False)


def cache_folder() -> str:
    """Warp's folder of compiled kernels."""
    return os.fspath(wp.config.kernel_cache_dir or "")
