"""What does not fit into the memory is told before the first serve, with what does."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from pace.config.base import ConfigError, compose, parse
from pace.config.commands import EvaluateConfig
from pace.evaluation import room
from pace.evaluation.__main__ import main as evaluate
from pace.evaluation.evaluate import require_rooms
from pace.evaluation.room import require_room
from pace.studies.compare import main as compare
from tests.helpers.outside import command
from tests.helpers.saved import save_run

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def two_gib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "available_memory", lambda: 2.0)


def test_worlds_and_records_have_to_fit() -> None:
    require_room(8_000_000, 8192, CPU)  # 1.9 GiB of records
    with pytest.raises(ConfigError, match=r"the records of 9,000,000 serves need about 2\.1 GiB of memory, and 2\.0"):
        require_room(9_000_000, 8192, CPU)
    with pytest.raises(ConfigError, match=r"65536 worlds need about 7\.0 GiB .*: num_worlds=11500 fits"):
        require_room(1000, 65536, CPU)
    require_room(1000, 65536, torch.device("cuda"))  # its memory is another


@pytest.mark.parametrize(
    ("asked", "cure"),
    [
        (("serves=1000000000", "num_worlds=4"), "fewer serves="),
        (("serves=20000000", "num_worlds=4"), "fewer serves="),
        (("warmup_serves=1000000", "num_worlds=20", "serves=20"), "warmup_serves="),
        (("num_worlds=16777216", "serves=1000000000"), "num_worlds=11500 fits"),
        (("first_ball=[0]", "first_ball_worlds=16777216"), "num_worlds=11500 fits"),
    ],
)
def test_an_evaluation_has_to_fit(asked: tuple[str, ...], cure: str) -> None:
    given = ["policy=zero", "rows=[mixed]", "first_ball=[]", "device=cpu", *asked]
    with pytest.raises(ConfigError, match=rf"GiB of memory, and 2\.0 are left: .*{cure}"):
        require_rooms(parse(compose("evaluate", given), EvaluateConfig), [])


def test_what_does_not_fit_is_one_line_before_the_first_serve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = save_run(tmp_path / "run"), tmp_path / "out"
    arguments = (str(run), "rows=[mixed]", "first_ball=[]", "device=cpu", f"out={out}")
    assert command(evaluate, *arguments, "serves=1000000000", "num_worlds=4") == 2
    assert re.fullmatch(r"error: .*GiB of memory, and 2\.0 are left: .*\n", capsys.readouterr().err)
    assert not out.exists()

    def full(*_: object) -> None:
        raise RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory")

    monkeypatch.setattr("pace.evaluation.evaluate.evaluate_table", full)
    assert command(evaluate, *arguments) == 1
    assert capsys.readouterr().err.startswith("error: the memory of this machine is full: ask for less at once")


@pytest.mark.long
def test_so_is_a_comparison(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs, out = [str(save_run(tmp_path / name)) for name in ("a", "b")], tmp_path / "out"
    assert command(compare, *runs, "serves=20000000", "num_worlds=4", "device=cpu", f"out={out}") == 2
    assert "the records of 40,000,016 serves need about 9.5 GiB" in capsys.readouterr().err
    assert not out.exists()
