"""Kernels found without running anything, compiled side by side, and found again by the same hash."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import warp as wp
from warp._src import context

from pace.arrays.launch import Launch
from pace.arrays.warm import Target, Wanted, compile_kernels, missing, rehearsal

CPU = torch.device("cpu")


def made(name: str, factor: float) -> wp.Kernel:
    """A kernel of its own module, made at run time as MuJoCo Warp's are."""

    @wp.kernel(module=wp.get_module(f"tests.warm.{name}"))
    def scale(x: wp.array[Any]):
        i = wp.tid()
        x[i] = x[i] * x.dtype(wp.static(factor))

    return scale


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[Path]:
    before, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, str(tmp_path)
    yield tmp_path
    wp.config.kernel_cache_dir = before


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the modules that are compiled, not those that lie there already."""
    names, compile_module = [], context.Module._compile

    def noted(module: Any, *args: Any, **kwargs: Any) -> bool:
        done = compile_module(module, *args, **kwargs)
        names.extend([module.name] * done)
        return done

    monkeypatch.setattr(context.Module, "_compile", noted)
    return names


def test_what_is_rehearsed_compiles_once_and_then_loads(cache: Path, compiled: list[str]) -> None:
    kernels = [made("one", 2.0), made("two", 3.0)]
    x, y = torch.ones(4), torch.ones(4, dtype=torch.float64)

    def work() -> None:
        for kernel in kernels:
            for values in (x, y):  # two versions of each kernel
                wp.launch(kernel, dim=4, inputs=[wp.from_torch(values)], device="cpu")

    with rehearsal() as found:
        work()
        Launch(kernels[0], 4, CPU, x=wp.from_torch(x))()
    assert [each.module.name for each in found] == ["tests.warm.one", "tests.warm.two"]
    assert x.tolist() == [1.0] * 4  # nothing was launched
    target = Target(wp.get_device("cpu"))
    assert missing(found, target) == found
    compile_kernels(found, target, 2)
    assert sorted(compiled) == ["tests.warm.one", "tests.warm.two"]
    assert missing(found, target) == []
    compile_kernels(found, target, 2)
    work()
    assert len(compiled) == 2  # a second time, and the run, compile nothing
    assert (x.tolist(), y.tolist()) == ([6.0] * 4, [6.0] * 4)


def test_a_gpus_blocks_are_noted_on_a_cpu() -> None:
    kernel, x = made("blocks", 2.0), wp.zeros(4, dtype=float, device="cpu")
    with rehearsal(of_a_gpu=True) as found:
        wp.launch(kernel, dim=4, inputs=[x], device="cpu")
        wp.launch(kernel, dim=4, inputs=[x], device="cpu", block_dim=64)
        assert wp.get_suggested_block_size(kernel, "cpu")[0] == 256
    assert found == [Wanted(kernel.module, 256), Wanted(kernel.module, 64)]


def test_a_gpu_that_is_not_there_gets_its_program_under_the_name_that_it_looks_for(cache: Path) -> None:
    if 90 not in context.runtime.nvrtc_supported_archs:
        pytest.skip("Warp has no CUDA compiler here")
    kernel = made("gpu", 2.0)
    with rehearsal(of_a_gpu=True) as found:
        wp.launch(kernel, dim=4, inputs=[wp.zeros(4, dtype=float, device="cpu")], device="cpu")
    compile_kernels(found, Target(arch=90), 1)
    assert missing(found, Target(arch=90)) == []
    identifier = kernel.module.get_module_identifier(256)
    assert (cache / identifier / f"{identifier}.sm90.cubin").exists()


def test_a_loop_that_ends_on_the_device_is_passed_once() -> None:
    kernel, passes = made("loop", 2.0), []
    x, condition = wp.zeros(4, dtype=float, device="cpu"), wp.ones(1, dtype=int, device="cpu")

    def body(steps: list[int]) -> None:
        steps.append(1)
        wp.launch(kernel, dim=4, inputs=[x], device="cpu")

    with rehearsal() as found:
        wp.capture_while(condition, body, steps=passes)
    assert passes == [1]
    assert [each.module for each in found] == [kernel.module]
