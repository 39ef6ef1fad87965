"""The suite itself: helpers are imported in one way, tests import no tests, and folders mirror the package's rooms."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import pace

TESTS = Path(__file__).parent
ROOM = Path(pace.__file__).parent
#: Folders that are no rooms: what all tests share, extensions of several rooms from outside, and what needs a GPU.
OTHERS = {"helpers", "seams", "gpu"}


def files() -> list[Path]:
    return sorted(file.relative_to(TESTS) for file in TESTS.rglob("*.py"))


def imported(file: Path) -> list[tuple[str, int, bool]]:
    """(module, level, whether names are taken from it) of every import of a file, at any depth."""
    found = []
    for node in ast.walk(ast.parse((TESTS / file).read_text())):
        if isinstance(node, ast.Import):
            found += [(alias.name, 0, False) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found.append((node.module or "", node.level, True))
    return found


def helpers() -> set[str]:
    return {f"tests.helpers.{file.stem}" for file in files() if file.parts[0] == "helpers"}


@pytest.mark.parametrize("file", files(), ids=str)
def test_helpers_are_imported_in_one_way_and_no_test_is(file: Path) -> None:
    """``from tests.helpers.NAME import ...``; a test's neighbours are no modules for it."""
    neighbours = {path.stem for path in files()}
    for module, level, names in imported(file):
        assert level == 0, f"relative import of {module}"
        if module.split(".")[0] == "tests":
            assert module in helpers(), module
            assert names, f"import {module}: use from {module} import ..."
        else:
            assert module not in neighbours


def test_a_helper_holds_no_test() -> None:
    names = {file.name for file in files() if file.parts[0] == "helpers"}
    assert not any(name.startswith(("test_", "conftest")) for name in names)


def test_every_helper_is_used() -> None:
    text = "\n".join((TESTS / file).read_text() for file in files())
    unused = {name for name in helpers() if f"from {name} import" not in text}
    assert unused == {"tests.helpers.stand_in"}  # a program that tests/runs/test_queue.py starts


@pytest.mark.parametrize("file", [file for file in files() if len(file.parts) > 1], ids=str)
def test_a_folder_of_tests_is_a_room_and_its_files_test_it(file: Path) -> None:
    if file.parts[0] in OTHERS:
        return
    assert file.name.startswith("test_")
    assert (ROOM / file.parent / "__init__.py").is_file()
    room = ".".join(("pace", *file.parent.parts))
    assert any(f"{module}.".startswith(f"{room}.") for module, _, _ in imported(file)), f"nothing of {room}"
