"""Every Warp kernel of the package compiles for the GPUs that it is meant for, without a GPU or a driver."""

from __future__ import annotations

import importlib
import sys
import time
from pathlib import Path

import pytest
import torch
import warp as wp

import pace
from tests.helpers.envs import make_env

ROOT = Path(pace.__file__).parent
ARCHITECTURES = (80, 90, 100)  # A100, H100, B200
LONGEST = 60.0  # s of processor time for one architecture: the ball's took 16 of one core, and 117 in one module before
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no CUDA compiler there"),
]


def modules() -> list[str]:
    """Modules of the package that define kernels."""
    files = sorted(file for file in ROOT.rglob("*.py") if "@wp.kernel" in file.read_text())
    return [".".join(file.relative_to(ROOT.parent).with_suffix("").parts) for file in files]


@pytest.fixture(scope="module", autouse=True)
def launched() -> None:
    """Kernels for several precisions get their versions when they are launched first, by each engine with its own."""
    for engine in ("native", "mjwarp"):
        env = make_env(2, engine, "cpu", overrides=["engine.physics_dt=0.01"])
        env.reset_worlds(torch.ones(2, dtype=torch.bool))


def test_there_are_kernels_in_every_room_that_needs_them() -> None:
    assert {name.split(".")[1] for name in modules()} >= {"arrays", "sim", "task"}


@pytest.mark.parametrize("name", modules())
def test_kernels_compile_for_a_gpu(name: str, tmp_path: Path) -> None:
    importlib.import_module(name)
    started = time.process_time()
    files = wp.compile_aot_module(wp.get_module(name), arch=ARCHITECTURES, module_dir=tmp_path, use_ptx=True)
    took = (time.process_time() - started) / len(ARCHITECTURES)
    assert took < LONGEST, "is a large function called in many places, or in a loop that is written out?"
    assert len(files) == len(ARCHITECTURES)
    for file, architecture in zip(files, ARCHITECTURES, strict=True):
        assert f".target sm_{architecture}" in file.read_text()
