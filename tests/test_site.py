"""The documentation as a site: all pages are in the navigation, the reference is of today's code, it builds clean."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from pace.onboard.estimates import ESTIMATES
from pace.rl.ppo import METRICS
from pace.runs.metrics_file import LEADING
from pace.task.observations import CRITIC, POLICY, width

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
#: Pages that the hooks make.
MADE = re.compile(r"reference/(commands|rewards|api|configuration/\w+)\.md")
LOADED = re.compile(r"<(?:script|link|img|source|iframe)\b[^>]*?(?:src|href)=\"?(https?:)?//", re.IGNORECASE)


class Loader(yaml.SafeLoader):
    """Reads mkdocs.yml: its tags for Python names are text here."""


Loader.add_multi_constructor("tag:yaml.org,2002:python/name:", lambda loader, suffix, node: suffix)


def navigation(part: Any) -> list[str]:
    """Pages in a part of the navigation."""
    if isinstance(part, str):
        return [part]
    return [page for inner in (part.values() if isinstance(part, dict) else part) for page in navigation(inner)]


def rows(page: str, heading: str) -> dict[str, str]:
    """First cell in code, and second cell, of the table below a heading."""
    section = (DOCS / page).read_text().split(f"{heading}\n")[1].split("\n## ")[0]
    return dict(re.findall(r"^\| `([^`]+)` \| ([^|]+?) \|", section, re.MULTILINE))


def test_every_page_is_in_the_navigation_once() -> None:
    listed = navigation(yaml.load((ROOT / "mkdocs.yml").read_text(), Loader)["nav"])
    written = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    assert sorted(page for page in listed if not MADE.fullmatch(page)) == sorted(written)


@pytest.mark.parametrize(("heading", "table"), [("## Of the actor", POLICY), ("## Of the critic", CRITIC)])
def test_the_tables_of_observations_are_those_of_the_code(heading: str, table: Any) -> None:
    sizes = {name: "J" if width(table[name].size, 21) == 21 else str(width(table[name].size, 21)) for name in table}
    assert rows("reference/observations.md", heading) == sizes


def test_every_metric_of_the_learner_is_explained() -> None:
    named = set(rows("reference/metrics.md", "# Metrics"))
    assert {*LEADING, *METRICS} - named == set()


def test_every_estimate_is_explained() -> None:
    named = set(re.findall(r"^\| `(\w+)`", (DOCS / "explanation" / "onboard.md").read_text(), re.MULTILINE))
    assert set(ESTIMATES) == named


@pytest.mark.long
def test_it_builds_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    line = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    pages = {page.relative_to(tmp_path).as_posix(): page.read_text() for page in tmp_path.rglob("*.html")}
    assert {"index.html", "reference/api.html", "reference/configuration/ball.html"} <= set(pages)
    assert [name for name, text in pages.items() if LOADED.search(text)] == []
    ball = pages["reference/configuration/ball.html"]
    assert "ball.paddle_restitution_slope" in ball
    assert "kg (ITTF)" in ball
