"""Numbers and tables as text, for the terminal and in Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

#: Makes a table from its header and its body.
Table = Callable[[Sequence[str], Sequence[Sequence[str]]], str]


def number(value: float | None, factor: float = 1.0, digits: int = 1) -> str:
    """``value`` times ``factor``, or a dash for NaN, which is None in JSON."""
    return "-" if value is None or math.isnan(value) else f"{factor * value:,.{digits}f}"


def interval(row: Mapping[str, Any], name: str, factor: float = 100.0) -> str:
    """The interval of a share, in per cent."""
    return f"{number(row[f'{name}_low'], factor)} to {number(row[f'{name}_high'], factor)}"


def text_table(header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Columns of equal width, the first to the left, the others to the right."""
    widths = [max(len(line[i]) for line in (header, *body)) for i in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        first, *rest = (cell.rjust(width) for cell, width in zip(cells, widths, strict=True))
        return "  ".join([first.strip().ljust(widths[0]), *rest]).rstrip()

    return "\n".join([line(header), line(["-" * width for width in widths]), *(line(cells) for cells in body)])


def markdown_table(header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """The same as Markdown."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (header, rule, *body))
