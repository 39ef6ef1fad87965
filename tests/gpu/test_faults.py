"""What goes wrong on a GPU, on one: found, named, and survived. (tests/arrays/test_graph.py and tests/test_devices.py
show the same on a CPU, with what stands for a GPU.)"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import warp as wp

from pace.arrays import graph
from pace.arrays.graph import CapturedCall, CudaGraph, Graphs, graphs_of
from pace.config.base import ConfigError
from pace.devices import card, has_code_for, resolve_device, seen_by_warp
from pace.rl.train import main as train
from tests.helpers.gpu import config_of, environment, play
from tests.helpers.outside import command

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")]
ROOT = Path(__file__).parents[2]


@pytest.fixture
def gpu(device: torch.device) -> torch.device:
    if device.type != "cuda":
        pytest.skip("needs a GPU")
    graph._SAID.clear()
    return device


def test_what_is_said_of_this_card(gpu: torch.device) -> None:
    assert has_code_for(card(gpu.index or 0))
    assert seen_by_warp().count == torch.cuda.device_count()


def test_a_card_that_is_not_there_or_hidden() -> None:
    with pytest.raises(ConfigError, match=r"device cuda:99 is not there: torch sees \d+ GPU"):
        resolve_device("cuda:99")
    code = "from pace.devices import resolve_device; print(resolve_device('auto'))"
    given = os.environ | {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run([sys.executable, "-c", code], env=given, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "cpu", done.stderr


def test_auto_goes_on_without_a_graph(gpu: torch.device, capsys: pytest.CaptureFixture[str]) -> None:
    """A read of the host cannot be captured. Numbers go on as if nothing had been tried."""
    totals = []
    for graphs in (Graphs.NONE, Graphs.TRY):
        torch.manual_seed(4)
        generator, total = torch.Generator(gpu).manual_seed(3), torch.zeros((), device=gpu)

        def reading(total: torch.Tensor = total, generator: torch.Generator = generator) -> None:
            total.add_(torch.rand((), device=gpu, generator=generator) + torch.rand((), device=gpu))
            total.item()

        call = CapturedCall(reading, gpu, graphs, generator)
        for _ in range(5):
            call()
        totals.append(torch.stack([total, torch.rand((), device=gpu), torch.rand((), device=gpu, generator=generator)]))
    assert torch.equal(*totals)
    said = capsys.readouterr().err
    assert said.count("warning: no CUDA graphs") == 1
    assert "reading cannot be captured: " in said


@wp.kernel(module=wp.get_module("tests.gpu.late"))
def late(x: wp.array[float]):
    x[wp.tid()] += 1.0


def test_a_kernel_that_is_first_used_in_a_capture_is_named(gpu: torch.device) -> None:
    x, calls = wp.zeros(2, dtype=float, device=wp.device_from_torch(gpu)), []

    def function() -> None:
        calls.append(1)
        if len(calls) > 1:
            wp.launch(late, dim=2, inputs=[x], device=x.device)

    call = CapturedCall(function, gpu, Graphs.CUDA)
    call()
    with pytest.raises(RuntimeError, match=r"no CUDA graph, .*kernel 'late' is used for the first time"):
        call()
    torch.cuda.synchronize(gpu)
    good = CapturedCall(lambda: x.zero_(), gpu, Graphs.CUDA)
    for _ in range(3):
        good()
    assert isinstance(good._graph, CudaGraph)


def test_a_memory_pool_that_is_off(gpu: torch.device, capsys: pytest.CaptureFixture[str]) -> None:
    engine = config_of(gpu, 2, "auto").engine
    where = wp.device_from_torch(gpu)
    assert graphs_of(engine, gpu) is Graphs.TRY
    wp.set_mempool_enabled(where, False)
    try:
        assert graphs_of(engine, gpu) is Graphs.NONE
    finally:
        wp.set_mempool_enabled(where, True)
    assert "the memory pool of cuda:0 is off" in capsys.readouterr().err


def test_a_full_memory_is_one_line(gpu: torch.device, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """torch may have a thousandth of the card: less than the worlds need, and soon found."""
    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.set_per_process_memory_fraction(0.001, gpu)
    try:
        status = command(train, "num_worlds=65536", "samples=1e7", "minutes=0", f"device={gpu}", f"out={tmp_path}",
                         "progress=false")  # fmt: skip
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0, gpu)
    assert status == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: the GPU's memory is full (")
    assert "give a smaller num_worlds" in last


def test_a_second_environment_leaves_the_first_one_its_memory(gpu: torch.device) -> None:
    first = environment(gpu, 64, "always")
    play(first, [8])
    other = environment(gpu, 128, "always")
    play(other, [8])
    play(first, [4])
    del other
    gc.collect()
    torch.cuda.empty_cache()
    filling = [torch.full((2**22,), float("nan"), device=gpu) for _ in range(64)]  # what was freed is written over
    play(first, [8])
    assert len(filling) == 64
    assert first.first_bad() is None
    assert bool(first.policy_observation.isfinite().all())
    assert not first.worlds.engine.overflowed()
