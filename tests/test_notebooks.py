"""Every notebook runs from top to bottom, shows its figures, and says what it should; it is stored with its outputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parent.parent
#: Notebook -> (figures that it shows, sentences that it prints).
NOTEBOOKS = {
    "00_quickstart.ipynb": (2, ["trained for 50 M control steps", "learning_curve.png", "error of the predictor"]),
    "01_physics.ipynb": (
        5,
        ["bounce at x = -0.872 m after 0.459 s", "apex 1.035 m high", "come over the net and bounce on the robot's"],
    ),
    "02_policy.ipynb": (3, ["policy pretrained/pace, trained for", "serves ended", "this serve: met the ball after"]),
    "03_predictor.ipynb": (3, ["predictor=filter: 45 positions", "last 0.1 s: ", "metrics.csv"]),
    "04_your_reward.ipynb": (2, ["the policy gets 0.", "keeps its pose -0.", "['reward/high']"]),
    "05_your_robot.ipynb": (
        1,
        ["t1: 21 joints, 4 of them in the arm", "t1_29dof: 27 joints, 7", "learning_curve.png", "has no site paddle"],
    ),
}
#: Those that `make test` has the time for.
QUICK = ("01_physics.ipynb",)
LARGEST = 500_000  # bytes of a stored notebook


def outputs(notebook: Any) -> list[Any]:
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def read(name: str) -> Any:
    return nbformat.read(ROOT / "notebooks" / name, as_version=4)


def check(name: str, found: list[Any]) -> None:
    """Figures and sentences of a notebook's outputs."""
    figures, sentences = NOTEBOOKS[name]
    assert sum("image/png" in output.get("data", {}) for output in found) == figures
    text = "".join(output.get("text", "") for output in found)
    for sentence in sentences:
        assert sentence in text


def test_all_notebooks_are_tested() -> None:
    assert {path.name for path in (ROOT / "notebooks").glob("*.ipynb")} == set(NOTEBOOKS)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in QUICK else pytest.mark.long) for name in NOTEBOOKS]
)
def test_a_notebook_runs(name: str) -> None:
    notebook = read(name)
    # from the root, so that the kernel imports this checkout; an error in a cell is an error here
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(ROOT)}}).execute()
    check(name, outputs(notebook))


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_stored_with_its_outputs(name: str) -> None:
    check(name, outputs(read(name)))
    assert not [
        output for output in outputs(read(name)) if output.output_type == "error" or output.get("name") == "stderr"
    ]
    assert (ROOT / "notebooks" / name).stat().st_size < LARGEST


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_installs_what_is_missing(name: str) -> None:
    code = next(cell.source for cell in read(name).cells if cell.cell_type == "code")
    assert code.startswith("# On Colab this installs what is missing")
