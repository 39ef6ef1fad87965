"""Every Warp kernel of the package compiles for the GPUs that it is meant for, without a GPU or a driver."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
import torch
import warp as wp

import pace
from pace.task.env import make_env

ROOT = Path(pace.__file__).parent
ARCHITECTURES = (80, 90, 100)  # A100, H100, B200
LARGEST = 1_000_000  # characters of PTX of a module; the largest, pace.sim.ball.step_kernel, had 0.6 M in 12 s
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
    files = wp.compile_aot_module(wp.get_module(name), arch=ARCHITECTURES, module_dir=tmp_path, use_ptx=True)
    assert len(files) == len(ARCHITECTURES)
    for file, architecture in zip(files, ARCHITECTURES, strict=True):
        text = file.read_text()
        assert f".target sm_{architecture}" in text
        assert len(text) < LARGEST, "it would take minutes to compile: is a large function called in many places?"
