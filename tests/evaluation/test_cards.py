"""The committed model cards say what their policies, their commands and the files of their figures say."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from pace.evaluation.card import serves_table
from pace.evaluation.quality_report import more_tables
from pace.evaluation.text import markdown_table
from pace.rl.policies import load_policy

CARDS = sorted(Path("pretrained").glob("*/README.md"))
BASELINE = Path("docs/results/baseline")


@pytest.mark.parametrize("page", CARDS, ids=lambda page: page.parent.name)
def test_a_card_names_the_robot_and_ball_that_are_played(page: Path) -> None:
    config, text = load_policy(page.parent).config, page.read_text()
    task = next(line for line in text.splitlines() if line.startswith("| task"))
    for group in ("robot", "ball", "randomization", "sensing"):
        assert f"`{group}={getattr(config, group).name}`" in task, group


@pytest.mark.parametrize("page", CARDS, ids=lambda page: page.parent.name)
def test_a_card_s_command_says_which_task_it_plays(page: Path) -> None:
    commands = re.findall(r"`python -m pace\.evaluation ([^`]*)`", page.read_text())
    assert (len(commands) > 0) == (page.parent / "evaluation.json").is_file()
    for command, task in zip(commands, ("own", "table"), strict=False):
        assert command.split()[:2] == [str(page.parent), f"task={task}"]


@pytest.mark.parametrize("file", sorted(BASELINE.glob("*.json")), ids=lambda file: file.stem)
def test_a_card_has_the_baseline_s_tables(file: Path) -> None:
    found, text = json.loads(file.read_text()), Path("pretrained", file.stem, "README.md").read_text()
    own, table = text.split("## The table's task\n")
    assert found["task_name"] == "table"
    for part in (serves_table(found), *more_tables(found, markdown_table)):
        assert part in table
        assert part not in own
