"""The code on the pages: every command composes with today's keys and choices, every Python block compiles."""

from __future__ import annotations

import ast
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml

from pace.command.arguments import prepare
from pace.command.table import COMMANDS
from pace.config.base import compose

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs").glob("[ethr]*/*.md"))]
#: Pages with numbers of the past, whose commands are of their commits.
PAGES = [page for page in PAGES if page.parent.name != "results"]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: Commands that need what a reader has and a test has not: choices of their own, or Hydra's launchers.
LEFT_OUT = ("--config-dir", "-m", "--help")


def blocks(language: str) -> list[tuple[str, str]]:
    """(page, text) of all blocks in a language."""
    found = []
    for page in PAGES:
        name = page.relative_to(ROOT).as_posix()
        found += [(name, match[2]) for match in BLOCK.finditer(page.read_text()) if match[1] == language]
    return found


def commands() -> list[tuple[str, list[str]]]:
    """(page, words) of each command ``pace ...`` in blocks without a language or in bash."""
    found: list[tuple[str, list[str]]] = []
    for page, text in [*blocks("bash"), *blocks("")]:
        if page == "docs/extend.md":  # they run: tests/test_extend.py
            continue
        lines = re.findall(r"^(?:pace|python -m pace\.rl\.train) .*$", text.replace("\\\n", " "), re.MULTILINE)
        split = (shlex.split(line, comments=True) for line in lines)
        found += [(page, ["pace", "train", *words[3:]] if words[0] == "python" else words) for words in split]
    return [(page, words) for page, words in found if not set(LEFT_OUT) & set(words)]


@pytest.mark.parametrize(
    ("page", "words"), commands(), ids=lambda part: part if isinstance(part, str) else "-".join(part[:3])
)
def test_a_command_composes(page: str, words: list[str]) -> None:
    _, name, *arguments = words
    overrides = prepare(name, arguments)
    compose(COMMANDS[name].config, overrides)
    for override in overrides:
        if override.startswith("overrides="):
            recompose(override)


def recompose(collected: str) -> None:
    """Changes of a saved task are changes of the training, too."""
    value: Any = yaml.safe_load(collected.partition("=")[2])
    compose("train", [str(part) for part in value if not str(part).startswith("serve.")])


@pytest.mark.parametrize(("page", "text"), blocks("python"), ids=lambda part: part.splitlines()[0])
def test_a_python_block_compiles(page: str, text: str) -> None:
    ast.parse(text)


@pytest.mark.parametrize(("page", "text"), blocks("yaml"), ids=lambda part: part.splitlines()[0])
def test_a_yaml_block_is_yaml(page: str, text: str) -> None:
    assert yaml.safe_load(text)
