"""Folders that commands write: made and checked before the work, and nobody else's files are replaced."""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pace.bench.__main__ import main as bench
from pace.config.base import ConfigError
from pace.deploy.__main__ import main as export
from pace.evaluation.__main__ import main as evaluate
from pace.predictor.__main__ import main as predictor
from pace.rl import predictor_run, session
from pace.rl.train import main as train
from pace.runs.own_files import LIST, make_out
from pace.runs.run_folder import STAMP, RunFolder
from pace.studies.__main__ import main as studies
from pace.studies.ablate import main as ablate
from pace.studies.ball import main as validate
from pace.studies.compare import main as compare
from pace.viewer import play as viewer_play
from pace.viewer.__main__ import main as play
from tests.helpers.outside import SMALL, command


def test_commands_of_one_second_get_folders_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda _: "2026-01-01_00-00-00")
    with ThreadPoolExecutor(16) as pool:
        folders = list(pool.map(lambda _: make_out(None, "pace"), range(32)))
    assert sorted(folder.name for folder in folders) == sorted(
        ["2026-01-01_00-00-00_pace", *(f"2026-01-01_00-00-00_pace_{number}" for number in range(2, 33))]
    )


@pytest.mark.parametrize("out", ["a\0b", "x" * 300])
def test_a_name_that_no_folder_can_have_is_one_line(out: str) -> None:
    with pytest.raises(ConfigError, match="cannot be made"):
        make_out(out, "x")
    with pytest.raises(ConfigError, match="out=runs cannot be made"):
        make_out(None, out)


def test_a_run_that_cannot_start_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(train, *SMALL, "randomization.trunk_mass=[-20,-20]") == 2
    assert command(train, *SMALL, "randomization.trunk_mass=[-20,-20]", "out=given") == 2
    assert not list(tmp_path.glob("runs/*"))
    assert not (tmp_path / "given").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    assert command(train, *SMALL, "randomization.trunk_mass=[-20,-20]", "out=mine") == 2
    assert (tmp_path / "mine" / "notes.txt").read_text() == "mine"


def test_a_folder_is_made_and_nothing_is_left_in_it(tmp_path: Path) -> None:
    assert list(make_out(str(tmp_path / "a" / "b"), "x").iterdir()) == []


@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (evaluate, ("pretrained/pace", "rows=[mixed]", "serves=10000000", "num_worlds=64")),
        (bench, ("bench=quick",)),
        (ablate, ("samples=1e12",)),
        (studies, ("all",)),
        (train, ("samples=1e12", "processes=1")),
    ],
)
def test_an_out_that_cannot_be_a_folder_ends_in_one_line_before_the_work(
    main, arguments: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "taken").write_text("mine")
    assert command(main, *arguments, f"out={tmp_path / 'taken'}") == 2
    error = capsys.readouterr().err
    assert f"out={tmp_path / 'taken'} cannot be made: File exists" in error
    assert "Traceback" not in error
    assert (tmp_path / "taken").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "text"),
    [("config.yaml", "my: own settings\n"), ("config.yaml", "- a\n- list\n"), ("config.yaml", "{"),
     ("metrics.csv", "day,weight\n1,70\n"), ("metrics.csv", ""), ("versions.json", '{"packages": {}}'),
     ("learning_curve.png", "picture"), ("film.mp4", "film")],
)  # fmt: skip
def test_a_run_replaces_no_file_that_is_not_a_runs(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=f"{name} is no file that pace has written there, and is not replaced"):
        RunFolder(tmp_path, {"robot": {}, "algo": {}}, tensorboard=False, files=["film.mp4"])
    assert (tmp_path / name).read_text() == text
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_a_run_may_begin_again_in_its_own_folder(tmp_path: Path) -> None:
    for _ in range(2):
        run = RunFolder(tmp_path, {"robot": {}, "algo": {}}, tensorboard=False)
        run.log({"update": 1.0})
        run.close()


def test_a_run_of_before_there_was_a_list_may_begin_again(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(f"{STAMP}4\nrobot: {{}}\nalgo: {{}}\n")
    make_out(str(tmp_path), "x", ["page.md"])  # another command has written a list there
    for name in ("versions.json", "metrics.csv", "film.mp4"):
        (tmp_path / name).write_text("")
    run = RunFolder(tmp_path, {"robot": {}, "algo": {}}, tensorboard=False, files=["film.mp4"])
    run.log({"update": 1.0})
    run.close()
    written = {"config.yaml", "versions.json", "metrics.csv", "learning_curve.png", "film.mp4", "page.md"}
    assert set((tmp_path / LIST).read_text().split()) == written


def test_a_run_has_its_folder_before_the_work_and_leaves_none_if_it_ends_at_its_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The kernels are compiled first, which takes minutes; a SIGTERM then ends the command with its status."""
    warmed: list[bool] = []

    def terminated(*_: object) -> None:
        warmed.append((tmp_path / "run" / ".lock").exists())
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(session, "warm", terminated)
    before = signal.getsignal(signal.SIGTERM)
    assert command(train, *SMALL, "processes=1", f"out={tmp_path / 'run'}") == 75
    assert warmed == [True]
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) == before
    (tmp_path / "taken").write_text("mine")
    assert command(train, *SMALL, "processes=1", f"out={tmp_path / 'taken'}") == 2
    assert len(warmed) == 1
    assert "cannot be made" in capsys.readouterr().err


def test_a_predictor_and_a_video_have_their_folder_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[bool] = []

    def fails(*_: object) -> None:
        made.append((tmp_path / "new").is_dir())
        raise ConfigError("no such task")

    monkeypatch.setattr(predictor_run, "PredictorRun", fails)
    monkeypatch.setattr(viewer_play, "Show", fails)
    assert command(predictor, f"out={tmp_path / 'new'}") == 2
    assert command(play, "pretrained/pace", "--video", f"{tmp_path / 'new' / 'film.mp4'}") == 2
    assert made == [True, True]
    assert list(tmp_path.iterdir()) == []


def test_the_command_names_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "metrics.csv").write_text("day,weight\n1,70\n")
    assert command(train, f"out={tmp_path}", *SMALL) == 2
    assert f"{tmp_path / 'metrics.csv'} is no file that pace has written there" in capsys.readouterr().err


def test_files_of_others_are_not_replaced_and_own_ones_are(tmp_path: Path) -> None:
    (tmp_path / "notes.md").write_text("mine")
    with pytest.raises(ConfigError, match=r"notes.md is no file that pace has written there, and is not replaced"):
        make_out(str(tmp_path), "x", ["table.csv", "notes.md"])
    assert [file.name for file in tmp_path.iterdir()] == ["notes.md"]
    make_out(str(tmp_path), "x", ["table.csv"])
    (tmp_path / "table.csv").write_text("ours")
    make_out(str(tmp_path), "y", ["figure.png", "table.csv"])  # another command may write there too
    (tmp_path / "figure.png").write_text("ours")
    make_out(str(tmp_path), "x", ["table.csv", "figure.png"])
    assert (tmp_path / LIST).read_text().split() == ["figure.png", "table.csv"]
    assert (tmp_path / "notes.md").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "content", "own"),
    [
        ("evaluation.json", b'{"rows": [], "versions": {}}', True),
        ("sweep.json", b'{"cells": []}', True),
        ("bench.json", b'{"packages": {}, "git": null}', True),
        ("baseline_seed1.csv", b"update,samples,wall_s\n1,64,0.1\n", True),
        ("policy.onnx", b"..joint_names..nominal_pose..action_scale", True),
        ("evaluation.json", b'{"rows": []}', False),
        ("evaluation.json", b"[1", False),
        ("evaluation.json", b"\xff\xfe", False),
        ("policy.onnx", b"another network", False),
        ("data.csv", b"day,weight\n1,70\n", False),
        ("figure.png", b"\x89PNG", False),
    ],
)
def test_a_folder_of_before_there_was_a_list_is_known_by_its_content(
    name: str, content: bytes, own: bool, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    (tmp_path / "page.md").write_text("beside it")
    if own:
        make_out(str(tmp_path), "x", [name, "page.md"])
    else:
        with pytest.raises(ConfigError, match=f"{name} is no file that pace has written"):
            make_out(str(tmp_path), "x", [name, "page.md"])


#: A sweep of one cell.
FEW = ("reality=null", "variations.ball=[paper]", "variations.engine=[]", "first_ball=[]")
FEW += tuple(f"variations.{name}=[]" for name in ("noise", "latency", "friction", "trunk_mass", "gain"))


@pytest.mark.parametrize(
    ("main", "arguments", "name"),
    [
        (evaluate, ("policy=zero", "rows=[mixed]"), "evaluation.md"),
        (evaluate, ("policy=zero", "rows=[]", "--sweep", *FEW), "sweep.png"),
        (bench, ("bench=quick",), "bench.json"),
        (ablate, ("samples=1e12", "seeds=[1]"), "ablation.png"),
        (ablate, ("samples=1e12", "seeds=[1]"), "baseline_seed1.csv"),
        (studies, ("parity", "architecture"), "architecture.png"),
        (export, ("pretrained/pace",), "policy.onnx"),
        (compare, ("docs/results/recipe/steps_12_seed1.csv",), "compare.md"),
        (validate, (), "presets.png"),
        (play, ("pretrained/pace", "--video", "{folder}/film.mp4"), "film.mp4"),
        (train, SMALL, "versions.json"),
        (train, SMALL, "learning_curve.png"),
        (train, SMALL, "play.mp4"),
        (train, SMALL, "evaluation"),
        (predictor, (), "predictor.json"),
    ],
)
def test_every_command_asks_before_its_work(
    main, arguments: tuple[str, ...], name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text("mine")
    if main is not play:
        arguments = (*arguments, f"out={tmp_path}")
    assert command(main, *(each.format(folder=tmp_path) for each in arguments)) == 2
    assert f"{tmp_path / name} is no file that pace has written there" in capsys.readouterr().err
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [(name, "mine")]


@pytest.mark.long
def test_an_evaluation_may_be_repeated_in_its_folder(tmp_path: Path) -> None:
    small = ("policy=zero", "rows=[short]", "serves=2", "num_worlds=2", "warmup_serves=0", "physics_dt=0.02")
    small += ("first_ball=[]", "progress=false", "serve.max_duration=0.3", "device=cpu", f"out={tmp_path}")
    assert command(evaluate, *small) == 0
    assert command(evaluate, *small) == 0
    written = {file.name for file in tmp_path.iterdir()} - {LIST}
    assert written == set((tmp_path / LIST).read_text().split())
