"""Every notebook runs from top to bottom, shows its figures, and says what it should."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parent.parent
#: Notebook -> (figures that it shows, sentences that it prints).
NOTEBOOKS = {
    "01_physics.ipynb": (
        5,
        ["bounce at x = -0.872 m after 0.459 s", "apex 1.035 m high", "come over the net and bounce on the robot's"],
    ),
    "02_policy.ipynb": (3, ["policy pretrained/pace, trained for", "serves ended", "this serve: met the ball after"]),
}


def run(path: Path) -> list[Any]:
    """The outputs of all cells; an error in a cell is an error here."""
    notebook = nbformat.read(path, as_version=4)
    # from the root, so that the kernel imports this checkout
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(ROOT)}}).execute()
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def test_all_notebooks_are_tested() -> None:
    assert {path.name for path in (ROOT / "notebooks").glob("*.ipynb")} == set(NOTEBOOKS)


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs(name: str) -> None:
    figures, sentences = NOTEBOOKS[name]
    outputs = run(ROOT / "notebooks" / name)
    assert sum("image/png" in output.get("data", {}) for output in outputs) == figures
    text = "".join(output.get("text", "") for output in outputs)
    for sentence in sentences:
        assert sentence in text


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_stored_without_outputs(name: str) -> None:
    notebook = nbformat.read(ROOT / "notebooks" / name, as_version=4)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook.cells)
