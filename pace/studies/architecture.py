"""The rooms of the package as a picture: from the ground up, with what imports what, read from the files themselves."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product
from pathlib import Path
from textwrap import wrap

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

import pace
from pace.command.table import COMMANDS
from pace.runs.files import write_figure

ROOT = Path(pace.__file__).parent
#: Files beside the rooms that are no part of the picture: the package itself, and the list of commands that moved.
LEFT_OUT = ("__init__", "__main__", "moved")
HEIGHT, GAP = 0.66, 0.36  # inches: of a row, and the space between two
BOX, BESIDE = 2.8, 0.12  # inches: width of a box in a row of several, and the space between three and more
WIDE = 4.6  # of one that is alone in its row
LETTERS = 14.5  # of a room's description in an inch
LINES = 2  # of it in a box
SHADES = ("#e9edf2", "#fdf3dc", "#e3f1e3", "#dfeaf8", "#efe4f5")


@dataclass(frozen=True)
class Room:
    """A folder of the package, or a file beside the folders: its name, one line, rooms in it, and what it imports."""

    name: str
    purpose: str
    inner: tuple[str, ...]
    imports: frozenset[str]


def read_rooms(root: Path = ROOT) -> dict[str, Room]:
    """The rooms below ``root`` by name. Commands, which may import every room, are left out."""
    commands = {_file(root, command.module) for command in COMMANDS.values()}
    found = {}
    for path in sorted(root.iterdir()):
        folder = (path / "__init__.py").is_file()
        if (not folder and path.suffix != ".py") or path.stem in LEFT_OUT:
            continue
        files = [file for file in path.rglob("*.py") if file not in commands] if folder else [path]
        named = set().union(*(set(_imported(file)) for file in files))
        purpose = (
            ast.get_docstring(ast.parse((path / "__init__.py" if folder else path).read_text(encoding="utf-8"))) or ""
        ).strip()
        inner = tuple(sorted(part.parent.name for part in path.glob("*/__init__.py")))
        found[path.stem] = Room(path.stem, _first_sentence(purpose), inner, frozenset(named - {path.stem, *LEFT_OUT}))
    return {name: Room(name, r.purpose, r.inner, r.imports & set(found)) for name, r in found.items()}


def _file(root: Path, module: str) -> Path:
    """File of a command's module."""
    path = root.parent / module.replace(".", "/")
    return path / "__main__.py" if path.is_dir() else path.with_suffix(".py")


def _imported(file: Path) -> Iterator[str]:
    """Names of the rooms that a file imports, at any depth of it."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            whole = [f"{node.module}.{alias.name}" for alias in node.names] if node.module == "pace" else [node.module]
        else:
            whole = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        yield from (name.split(".")[1] for name in whole if name.startswith("pace."))


def _first_sentence(text: str) -> str:
    return " ".join(text.split()).partition(". ")[0].rstrip(".").replace("``", "")


def fitted(text: str, letters: int) -> list[str]:
    """As many of a sentence's clauses as fit into a box of so many letters a line, wrapped."""
    clauses = re.split(r"(?<=[:;,]) ", text)
    for count in range(len(clauses), 0, -1):
        lines = wrap(" ".join(clauses[:count]).rstrip(":;,"), letters)
        if len(lines) <= LINES:
            return lines
    return wrap(clauses[0], letters)[:LINES]


def levels(rooms: Mapping[str, Room]) -> dict[str, int]:
    """Level of each room: 0 imports nothing, others stand one above the highest that they import."""
    found: dict[str, int] = {}

    def level(name: str) -> int:
        if name not in found:
            found[name] = 1 + max((level(other) for other in rooms[name].imports), default=-1)
        return found[name]

    for name in rooms:
        level(name)
    return found


def arrows(rooms: Mapping[str, Room]) -> list[tuple[str, str]]:
    """Pairs of a room and one that it imports, but for those that follow from the others."""

    def below(name: str) -> frozenset[str]:
        return rooms[name].imports.union(*(below(other) for other in rooms[name].imports))

    return [
        (name, other)
        for name, room in sorted(rooms.items())
        for other in sorted(room.imports)
        if not any(other in below(between) for between in room.imports - {other})
    ]


def arrange(rooms: Mapping[str, Room]) -> list[tuple[str, ...]]:
    """Rows from the ground up, each in the order that crosses the fewest arrows and keeps them short."""
    level = levels(rooms)
    rows = [sorted(name for name in rooms if level[name] == i) for i in range(max(level.values()) + 1)]
    pairs = arrows(rooms)

    def cost(chosen: Sequence[Sequence[str]]) -> tuple[int, float]:
        x = {name: place for row in chosen for name, place in zip(row, _places(len(row), 0.0), strict=True)}
        crossed = sum(
            (x[a] - x[c]) * (x[b] - x[d]) < 0
            for (a, b), (c, d) in combinations(pairs, 2)
            if level[a] == level[c] and level[b] == level[d]
        )
        return crossed, sum((x[a] - x[b]) ** 2 for a, b in pairs)

    return list(min(product(*(permutations(row) for row in rows)), key=cost))


def _places(count: int, middle: float) -> list[float]:
    """Middles of so many boxes in a row, inches."""
    apart = BOX + (BESIDE if count > 2 else 0.5)
    return [middle + (i - (count - 1) / 2) * apart for i in range(count)]


def described(rooms: Mapping[str, Room]) -> str:
    """The arrows as text, which the picture's file holds: a test compares it with the code."""
    return "; ".join(f"{name} -> {other}" for name, other in arrows(rooms))


def draw(rooms: Mapping[str, Room]) -> Figure:
    """The picture."""
    rows = arrange(rooms)
    height = len(rows) * (HEIGHT + GAP) + 0.2
    width = BESIDE + max(3, *(len(row) for row in rows)) * (BOX + BESIDE)
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(0.0, height))
    axes.axis("off")
    middles, widths = {}, {}
    for i, row in enumerate(rows):
        y = 0.12 + i * (HEIGHT + GAP) + HEIGHT / 2
        for name, x in zip(row, _places(len(row), width / 2), strict=True):
            middles[name], widths[name] = (x, y), WIDE if len(row) == 1 else BOX
            _box(axes, rooms[name], x, y, widths[name], SHADES[min(i // 2, len(SHADES) - 1)])
    for upper, lower in arrows(rooms):
        _arrow(axes, middles, widths, upper, lower, [b for a, b in arrows(rooms) if a == upper])
    note = (
        "An arrow: imports. A room may also import what lies further down its arrows. Commands may import every room."
    )
    axes.text(width / 2, height - 0.2, note, ha="center", va="center", size=9.5, color="#444444")
    return figure


def _box(axes: Axes, room: Room, x: float, y: float, width: float, shade: str) -> None:
    corner = (x - width / 2, y - HEIGHT / 2)
    shape = FancyBboxPatch(corner, width, HEIGHT, "round,pad=0,rounding_size=0.06", fc=shade, ec="#6b7785", lw=1.0)
    axes.add_patch(shape)
    inner = f"   ({', '.join(room.inner)})" if room.inner else ""
    lines = fitted(room.purpose, round(LETTERS * width))
    up = 0.19 if len(lines) > 1 else 0.12
    axes.text(x, y + up, room.name + inner, ha="center", va="center", size=11, weight="bold", color="#1d2733")
    style = {"ha": "center", "va": "center", "size": 8.8, "color": "#333333", "linespacing": 1.15}
    axes.text(x, y - 0.11 if len(lines) > 1 else y - 0.12, "\n".join(lines), **style)


def _arrow(
    axes: Axes,
    middles: Mapping[str, tuple[float, float]],
    widths: Mapping[str, float],
    upper: str,
    lower: str,
    all_lower: Sequence[str],
) -> None:
    """From the lower edge of ``upper``, shared among its arrows, to the upper edge of ``lower``."""
    (x, y), (to_x, to_y) = middles[upper], middles[lower]
    order = sorted(all_lower, key=lambda name: middles[name][0])
    share = (order.index(lower) + 1) / (len(order) + 1) - 0.5
    start, reach = x + share * widths[upper] * 0.8, 0.4 * widths[lower]
    end = min(max(start, to_x - reach), to_x + reach)
    line = {"arrowstyle": "-|>", "color": "#6b7785", "lw": 1.3, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 12}
    axes.annotate("", xy=(end, to_y + HEIGHT / 2), xytext=(start, y - HEIGHT / 2), arrowprops=line)


def write(out: Path, rooms: Mapping[str, Room] | None = None) -> Path:
    """Draw ``architecture.png`` into the folder ``out``."""
    rooms = rooms or read_rooms()
    file = out / "architecture.png"
    write_figure(file, draw(rooms), dpi=100, metadata={"Description": described(rooms)})
    return file
