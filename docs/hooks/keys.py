"""Tables of the configuration: the keys of a YAML file with types, ranges, units and sources.

Defaults and comments are those of configs/, types those of the dataclasses, ranges those of pace/config/limits.py.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from pace.command.keys import Key, file_keys, heading
from pace.config.base import config_dir
from pace.config.limits import TINY, limits_of
from pace.config.names import choices

FIELD = re.compile(r"    (\w+): [^#]*(?:#\s*(.*))?$")
Place = tuple[type, str]  # a class of the configuration and the name of one of its fields


def place_of(owner: type, dotted: str) -> Place | None:
    """The class and the field that a key such as ``mocap.rate`` belongs to; the last known one for keys of a table."""
    found = None
    for name in dotted.split("."):
        if not is_dataclass(owner) or name not in {field.name for field in fields(owner)}:
            return found
        found = (owner, name)
        hint = get_type_hints(owner)[name]
        owner = next(iter(_classes(hint)), object)
    return found


def _classes(hint: Any) -> Iterator[type]:
    """The dataclasses in an annotation, such as that of ``dict[str, RewardTerm]``."""
    if is_dataclass(hint):
        yield hint  # type: ignore[misc]
    for part in get_args(hint):
        yield from _classes(part)


def type_text(place: Place) -> str:
    """The type of a key, as a reader of YAML needs it."""
    owner, name = place
    text = next(str(field.type) for field in fields(owner) if field.name == name)
    return text.replace("Range", "[low, high]").replace(" | None", " or null").replace("None", "null")


def range_text(place: Place) -> str:
    """The range of a key."""
    limits = limits_of(*place)
    if limits is None:
        return ""
    low, high = (number(limit) for limit in limits)
    if limits[0] == TINY:
        return f"above 0, to {high}"
    return f"at least {low}" if limits[1] == math.inf else f"{low} to {high}"


def number(value: float) -> str:
    """A limit as text."""
    return f"{value:,}" if isinstance(value, int) else f"{value:g}"


def field_comments(owner: type) -> dict[str, str]:
    """Comment of each field of a class: that in its line, or the lines above it."""
    found: dict[str, str] = {}
    for cls in reversed([cls for cls in owner.__mro__ if is_dataclass(cls)]):
        above: list[str] = []
        for line in inspect.getsource(cls).splitlines():
            match = FIELD.match(line)
            if match:
                found[match[1]] = " ".join([*above, match[2] or ""]).strip()
            above = [*above, line.strip().lstrip("# ")] if line.startswith("    #") else []
    return found


def cell(text: str) -> str:
    """Text for a cell of a table."""
    return text.replace("|", "\\|").replace("<", "&lt;").strip()


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def key_table(keys: list[Key], owner: type, prefix: str = "") -> str:
    """Keys with default, type, range and comment."""
    rows = []
    for key in keys:
        place = place_of(owner, key.name)
        said = key.comment or (field_comments(place[0]).get(place[1], "") if place else "")
        kind, limits = (type_text(place), range_text(place)) if place else ("", "")
        rows.append((f"`{prefix}{key.name}`", f"`{cell(key.default)}`", cell(kind), limits, cell(said)))
    return table(("key", "default", "type", "range", "meaning, unit, source"), rows)


def value_table(keys: list[Key], prefix: str) -> str:
    """Keys with value and comment."""
    rows = [(f"`{prefix}{key.name}`", f"`{cell(key.default)}`", cell(key.comment)) for key in keys]
    return table(("key", "value", "meaning, unit, source"), rows)


def class_table(owner: type) -> str:
    """The fields of a class whose members are in a list or a table of YAML."""
    said = field_comments(owner)
    rows = [
        (
            f"`{field.name}`",
            cell(type_text((owner, field.name))),
            range_text((owner, field.name)),
            cell(said.get(field.name, "")),
        )
        for field in fields(owner)
    ]
    return table(("key", "type", "range", "meaning, unit"), rows)


def listed_classes(owner: type) -> dict[str, type]:
    """Classes in lists and tables of a class, at any depth, by name."""
    found: dict[str, type] = {}
    for hint in get_type_hints(owner).values():
        for cls in _classes(hint):
            if cls is not hint and hint != cls | None:
                found[cls.__name__] = cls
            found |= listed_classes(cls)
    return found


def group_page(group: str, owner: type, default: str, about: str) -> str:
    """All choices of a group: the default one whole, of the others what differs."""
    files = {choice: config_dir() / group / f"{choice}.yaml" for choice in choices(group)}
    first = {name: key for name, key in file_keys(files[default]).items() if name != "name"}
    parts = [
        f"# {group}",
        about,
        f"`pace train {group}=CHOICE` takes one, `pace train {group}.KEY=VALUE` changes a number.",
    ]
    parts += [f"## {group}={default}", f"The default. {heading(files[default])}".strip()]
    parts.append(key_table(list(first.values()), owner, f"{group}."))
    for choice, file in files.items():
        if choice != default:
            parts += [f"## {group}={choice}", heading(file), _difference(file, first, f"{group}.")]
    for name, cls in listed_classes(owner).items():
        parts += [f"## {name}", _docstring(cls), class_table(cls)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _difference(file: Path, first: dict[str, Key], prefix: str) -> str:
    own = [key for name, key in file_keys(file).items() if name != "name"]
    other = [key for key in own if key.name not in first or key.default != first[key.name].default]
    return value_table(other, prefix) if other else "The same numbers."


def _docstring(cls: type) -> str:
    text = inspect.getdoc(cls) or ""
    return "" if text.startswith(f"{cls.__name__}(") else re.sub(r":class:`([\w.]+)`", r"`\1`", text.replace("``", "`"))
