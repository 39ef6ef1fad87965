"""The rooms of the package: what each may import, no circle between files, and nothing that imports a command."""

from __future__ import annotations

import ast
import re
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import pace
from pace.command.table import COMMANDS
from pace.moved import MOVED

ROOT = Path(pace.__file__).parent
#: From the ground up, rooms that stand side by side in one line. A file imports from its own room and the lines above.
ORDER = (
    ("config",),
    ("moved", "lazy", "cgroups"),
    ("cores", "memory"),
    ("devices", "exchange"),
    ("arrays", "distributed", "command"),
    ("runs",),
    ("sim.robot_spec",),  # what is known of a robot without simulating it
    ("sim.robot",),
    ("sim.ball", "sim.engine"),
    ("sim",),
    ("predictor",),
    ("onboard",),
    ("task",),
    ("rl",),
    ("interfaces",),
    ("evaluation",),
    ("deploy",),
    ("viewer",),
    ("bench",),
    ("studies",),
)
LEVEL = {room: level for level, rooms in enumerate(ORDER) for room in rooms}


@lru_cache
def modules() -> dict[str, Path]:
    """Files of the package by the names of their modules; a room's ``__init__`` has the name of the room."""
    names = {}
    for file in sorted(ROOT.rglob("*.py")):
        parts = file.relative_to(ROOT.parent).with_suffix("").parts
        names[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return names


@lru_cache
def commands() -> frozenset[str]:
    """Files that are commands; they may import every room."""
    given = {command.module for command in COMMANDS.values()}
    return frozenset({"pace.__main__"} | {f"{name}.__main__" if is_room(name) else name for name in given})


def is_room(module: str) -> bool:
    return modules()[module].name == "__init__.py"


@lru_cache
def imports(module: str) -> frozenset[str]:
    """Modules of the package that ``module`` imports, at any depth: in functions and under TYPE_CHECKING too."""
    found = set()
    for node in ast.walk(ast.parse(modules()[module].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                found.add(name if name in modules() else str(node.module))
    return frozenset(name for name in found if name in modules())


def room(module: str) -> str:
    """Room of a module: the longest name of :data:`LEVEL` that it begins with; the package itself has none."""
    name = module.removeprefix("pace.")
    fitting = [known for known in LEVEL if name == known or name.startswith(f"{known}.")]
    return max(fitting, key=len, default="")


def files() -> list[str]:
    """Modules that are neither commands nor the package itself, which gives its public names on first use."""
    return [module for module in modules() if module not in commands() and module != "pace"]


def test_every_file_is_in_a_room() -> None:
    assert [module for module in files() if not room(module)] == []
    assert {module for module in modules() if module.endswith(".__main__")} <= commands() <= set(modules())


@pytest.mark.parametrize("module", files())
def test_a_file_imports_from_its_own_room_or_from_below(module: str) -> None:
    own = room(module)
    others = [other for other in imports(module) if room(other) not in (own, "")]
    assert [other for other in others if LEVEL[room(other)] >= LEVEL[own]] == []


def test_there_is_no_circle_between_files() -> None:
    graph = {module: imports(module) - {module} for module in files()}
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(f"circle: {' -> '.join(error.args[1])}")


def test_nothing_imports_a_command() -> None:
    found = [(module, other) for module in modules() for other in imports(module) if other in commands()]
    assert found == []


@pytest.mark.parametrize(
    "name", sorted({room for line in ORDER for room in line if (ROOT / room.replace(".", "/")).is_dir()})
)
def test_a_room_says_what_belongs_in_it(name: str) -> None:
    text = ast.get_docstring(ast.parse(modules()[f"pace.{name}"].read_text())) or ""
    assert len(text.splitlines()) >= 3
    assert re.search(r"\b(not|nothing)\b", text)
    assert "mport" in text


def test_old_commands_are_no_files() -> None:
    assert set(MOVED) & set(modules()) == set()
