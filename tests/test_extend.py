"""The recipes of docs/extend.md: their files are written into a folder and their commands run, with tiny settings."""

from __future__ import annotations

import importlib
import re
import runpy
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from pace.command.table import COMMANDS
from pace.onboard.estimates import ESTIMATES
from pace.rl.policies import load_policy
from pace.runs.metrics import read_metrics
from tests.helpers.outside import SMALL, command, stranger

PAGE = Path(__file__).parents[1] / "docs" / "extend.md"
LINES = 15  # of code and commands in a recipe
TINY = {
    "train": SMALL,
    "evaluate": (
        "serves=2",
        "num_worlds=2",
        "warmup_serves=0",
        "physics_dt=0.01",
        "engine.threads=1",
        "first_ball=[]",
        "progress=false",
    ),
    "export": ("check_worlds=2", "check_steps=3"),
}
ROWS = "rows=[short]"  # of an evaluation that names none
TABLE = "## What each addition costs"


class Block(NamedTuple):
    """A fenced block of the page: its language and lines."""

    language: str
    lines: tuple[str, ...]

    @property
    def code(self) -> int:
        """Commands, and lines that are neither empty nor a comment nor a docstring."""
        if self.language == "bash":
            return len(commands(self))
        return sum(bool(line.strip()) and not line.strip().startswith(("#", '"""')) for line in self.lines)


def recipes() -> dict[str, list[Block]]:
    """The blocks of each section of the page that has some."""
    found = {}
    for section in PAGE.read_text().split("\n## ")[1:]:
        blocks = re.findall(r"^```(\w+)\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
        if blocks:
            found[section.splitlines()[0]] = [Block(name, tuple(text.splitlines())) for name, text in blocks]
    return found


def commands(block: Block) -> list[list[str]]:
    """Command lines of a shell block, as a shell splits them."""
    text = "\n".join(block.lines).replace("\\\n", " ")
    whole, lines = "", []
    for line in text.splitlines():
        whole += f" {line.strip()}"
        if whole.count('"') % 2 == 0:
            lines.append(shlex.split(whole, comments=True))
            whole = ""
    assert not whole.strip()
    return [line for line in lines if line]


def run(line: list[str]) -> None:
    """A command of the page in this process, smaller."""
    program, name, *arguments = line
    if program == "python":
        runpy.run_path(name, run_name="__main__")
        return
    assert program == "pace"
    tiny = list(TINY[name])
    if name == "evaluate" and not any(argument.startswith("rows=") for argument in arguments):
        tiny.append(ROWS)
    main = importlib.import_module(entry_point(name)).main
    assert command(main, *arguments, *tiny) == 0, line


def entry_point(name: str) -> str:
    """Module with the ``main`` of a command."""
    module = COMMANDS[name].module
    return module if module == "pace.rl.train" else f"{module}.__main__"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty working folder, in a process that knows nothing of other recipes."""
    monkeypatch.chdir(tmp_path)
    before = dict(ESTIMATES)
    with stranger(tmp_path):
        yield tmp_path
    ESTIMATES.clear()
    ESTIMATES.update(before)


def test_there_are_seven_of_at_most_fifteen_lines() -> None:
    length = {name: sum(block.code for block in blocks) for name, blocks in recipes().items()}
    things = ("reward term", "observation", "on-board estimator", "serve", "ball", "robot", "algorithm")
    assert [name.split(" ", 1)[1] for name in length] == list(things)
    assert {name: count for name, count in length.items() if count > LINES} == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(recipes()))
def test_a_recipe_works_as_it_is_written(name: str, folder: Path) -> None:
    trained = []
    for block in recipes()[name]:
        if block.language in ("python", "yaml"):
            file = folder / block.lines[0].removeprefix("# ")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("\n".join(block.lines) + "\n")
    for block in recipes()[name]:
        for line in commands(block) if block.language == "bash" else ():
            run(line)
            trained += [argument.removeprefix("out=") for argument in line if argument.startswith("out=")]
    assert trained
    for path in trained:
        assert read_metrics(folder / path / "metrics.csv")["update"] == [1, 2]
    check(name, folder / trained[0])


def check(name: str, trained: Path) -> None:
    """What the page says of a recipe's run."""
    metrics, policy = read_metrics(trained / "metrics.csv"), load_policy(trained)
    if "reward" in name:
        assert max(metrics["reward/calm"]) < 0
    elif "observation" in name:
        assert policy.config.observation.policy[-1] == "sight:height_over_table"
    elif "estimator" in name:
        run(["pace", "evaluate", str(trained), "plugins=[mean_ball]"])
        run(["pace", "export", str(trained), "plugins=[mean_ball]", f"out={trained}"])
        assert b"mean.mean" in (trained / "policy.onnx").read_bytes()
    elif "serve" in name:
        assert policy.config.serve.vx == [-4.6, -4.2]
        assert policy.config.predictor.priors is not None
        assert policy.config.predictor.priors.launch_velocity.mean[0] == pytest.approx(-4.4)
    elif "ball" in name:
        assert policy.config.ball.mass == 0.004
    elif "robot" in name:
        run(["pace", "evaluate", str(trained)])
        assert policy.make_env(2, "cpu", 1, ["engine.threads=1"]).action_spec.shape == (2, 22)
    else:
        assert max(metrics["policy_std"]) == pytest.approx(0.25)


def test_the_table_names_files_that_are_there() -> None:
    root = PAGE.parents[1]
    named = re.findall(r"`((?:pace|configs)/[\w/.]*)`", PAGE.read_text().split(TABLE)[1])
    assert named
    assert [path for path in named if not (root / path).exists()] == []
