"""The page of ``tests/gpu`` is filled on a CPU too, in tiny sizes: so it works when a GPU is there at last."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SECTIONS = (
    "Parity of the engines", "Graphs against calls", "Two runs of one seed", "Killed and resumed",
    "Speed and memory by worlds", "An update of the paper's networks beside rsl_rl's", "Learning", "Its evaluation",
)  # fmt: skip


@pytest.mark.long
def test_the_page_has_all_its_sections(tmp_path: Path) -> None:
    file = tmp_path / "page.md"
    given = os.environ | {"PACE_GPU_TESTS_DEVICE": "cpu", "PACE_GPU_PAGE": str(file), "PYTHONPATH": str(ROOT)}
    line = [sys.executable, "-m", "pytest", "-m", "gpu", "-s", "tests/gpu/test_page.py"]
    done = subprocess.run(line, cwd=ROOT, env=given, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:]
    page = file.read_text()
    assert [name for name in SECTIONS if f"\n## {name}" not in page] == []
    assert page in done.stdout + "\n"  # and it is printed
