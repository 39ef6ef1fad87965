"""Keys of a YAML file with their defaults and comments, as ``--help`` shows them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import yaml

KEY = re.compile(r"( *)(\w+):(?: |$)")
HIDDEN = ("defaults", "hydra")  # Hydra's own
NO_ITEM = 1_000  # an indentation that no line has


@dataclass(frozen=True)
class Key:
    """A key by its full name, its default as written in the file, and its comment."""

    name: str
    default: str
    comment: str


def file_keys(file: Path) -> dict[str, Key]:
    """Keys of ``file`` by name, after those of the files of its group in its ``defaults``.

    A comment belongs to the key in its line, or to the next key if it stands above that, at its indentation. The
    comment of a key that only holds others goes to the first of those.
    """
    text = file.read_text(encoding="utf-8")
    found: dict[str, Key] = {}
    parts = re.search(r"^defaults: \[([\w, ]+)\]", text, re.MULTILINE)
    for part in parts[1].split(",") if parts else ():
        found |= file_keys(file.with_name(f"{part.strip()}.yaml"))
    values = yaml.load(text, yaml.BaseLoader)  # numbers stay as they are written
    pending = ""
    for name, comment in read_comments(text.splitlines()[len(_head(text)) :]):
        if name.split(".")[0] in HIDDEN:
            continue
        value = _at(values, name)
        if isinstance(value, dict) and not re.search(rf"^ *{name.split('.')[-1]}: *\{{", text, re.MULTILINE):
            pending = comment
            continue
        said = comment or (found[name].comment if name in found else "")
        found[name] = Key(name, flow(value), f"{said} ({pending})".lstrip() if pending else said)
        pending = ""
    return found


def heading(file: Path) -> str:
    """The comment at the top of ``file``, on the whole file."""
    return " ".join(
        line.lstrip("# ") for line in _head(file.read_text(encoding="utf-8")) if not line.startswith("# @package")
    )


def _head(text: str) -> list[str]:
    """The lines of the comment at the top of a file."""
    return list(takewhile(lambda line: line.startswith("#"), text.splitlines()))


def _at(values: Any, name: str) -> Any:
    for part in name.split("."):
        values = values[part]
    return values


def flow(value: Any) -> str:
    """A value of YAML in one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {flow(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(flow(part) for part in value) + "]"
    return str(value)


def read_comments(lines: Sequence[str]) -> list[tuple[str, str]]:
    """Full name of each key of a YAML file that begins a line, in order, and its comments."""
    keys: list[tuple[str, str]] = []
    path: list[tuple[int, str]] = []  # indentation and name of the keys around the current line
    above: list[tuple[int, str]] = []  # comments that stand alone, with their indentation
    item = NO_ITEM  # indentation of the list item that the current line is in
    for line in lines:
        content, _, comment = (part.rstrip() for part in line.partition("#"))  # no value in our files holds a #
        indent = len(line) - len(line.lstrip())
        match = KEY.match(content)
        if not content:
            above = [*above, (indent, comment.strip())] if comment else []
            continue
        if match and indent <= item:
            path = [(column, name) for column, name in path if column < indent] + [(indent, match[2])]
            _add(keys, [text for column, text in above if column != indent])
            own = [text for column, text in above if column == indent]
            keys.append((".".join(name for _, name in path), " ".join([*own, comment.strip()]).strip()))
            item = NO_ITEM
        else:
            item = indent if content.lstrip().startswith("- ") else item
            _add(keys, [*(text for _, text in above), comment.strip()])
        above = []
    _add(keys, [text for _, text in above])
    return keys


def _add(keys: list[tuple[str, str]], comments: Sequence[str]) -> None:
    """Add ``comments`` to those of the last key."""
    if keys:
        name, said = keys[-1]
        keys[-1] = (name, " ".join(text for text in (said, *comments) if text))
