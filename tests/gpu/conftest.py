"""The device of these tests, the sizes that suit it, and the page that is printed at their end.

``PACE_GPU_TESTS_DEVICE=cpu`` tries on a CPU, in tiny sizes, what fills the page (its figures then say nothing), and
``PACE_GPU_PAGE=FILE`` also writes the page.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import pytest
import torch

from pace.runs.run_folder import git_state
from tests.helpers.gpu import CPU, GPU, Sizes

DEVICE = os.environ.get("PACE_GPU_TESTS_DEVICE", "cuda:0")
PACKAGES = ("torch", "torchrl", "warp-lang", "mujoco-warp", "mujoco")
#: Title -> text, in the order of the tests.
SECTIONS: dict[str, str] = {}


@pytest.fixture
def device() -> torch.device:
    found = torch.device(DEVICE)
    if found.type == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    return found


@pytest.fixture
def sizes(device: torch.device) -> Sizes:
    return GPU if device.type == "cuda" else CPU


@pytest.fixture
def page() -> Callable[[str, str], None]:
    """Adds a section: title and text."""

    def add(title: str, text: str) -> None:
        SECTIONS[title] = text
        print(f"\n## {title}\n\n{text}\n", flush=True)  # at once, too: a lent machine may be gone at the end

    return add


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the page."""
    if not SECTIONS:
        return
    text = "\n\n".join([head(), *(f"## {title}\n\n{body}" for title, body in SECTIONS.items())])
    terminalreporter.section("the page of docs/results/gpu.md")
    terminalreporter.write_line(text)
    if file := os.environ.get("PACE_GPU_PAGE"):
        Path(file).write_text(text + "\n")


def head() -> str:
    """Card, driver, versions, commit and command in one paragraph."""
    git = git_state(Path(__file__).parent)
    commit = "unknown" if git is None else git["commit"][:7] + (" with changes" if git["dirty"] else "")
    packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    where = f"{card()}, {os.cpu_count()} cores, Python {platform.python_version()}, {packages}"
    command = " ".join(["python -m pytest", *sys.argv[1:]])
    return f"{where}, commit {commit}, {datetime.now(UTC):%Y-%m-%d}. `{command}`"


def card() -> str:
    """Name, driver and memory of the card, as its driver says."""
    if torch.device(DEVICE).type != "cuda":
        return "a CPU (the figures say nothing)"
    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    try:
        done = subprocess.run(query, capture_output=True, text=True, check=False)
        said = done.stdout.strip().splitlines() if done.returncode == 0 else []
    except FileNotFoundError:
        said = []
    name = said[torch.device(DEVICE).index or 0] if said else torch.cuda.get_device_name(DEVICE)
    return f"{name}, CUDA {torch.version.cuda}"
