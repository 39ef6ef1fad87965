"""Weights & Biases as a logger: what it is handed, that it is never needed, and the real package without a network."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from pace.config.base import ConfigError
from pace.runs import tracker
from pace.runs.run_folder import RunFolder

ROW = {"update": 1.0, "samples": 100.0, "hit_rate": float("nan"), "lr": 0.5}


class Recorded:
    """What the fake package was asked."""

    def __init__(self) -> None:
        self.begun: list[dict[str, Any]] = []
        self.rows: list[dict[str, Any]] = []
        self.files: list[str] = []
        self.finished = 0


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> Recorded:
    """A package that records, in place of wandb."""
    said = Recorded()

    class Artifact:
        def __init__(self, name: str, type: str) -> None:
            self.name, self.type = name, type

        def add_file(self, file: str) -> None:
            said.files.append(Path(file).name)

    def init(**given: Any) -> Any:
        said.begun.append(given)
        return SimpleNamespace(
            id=given["id"],
            define_metric=lambda name, step_metric: None,
            log=said.rows.append,
            log_artifact=lambda artifact: None,
            finish=lambda: setattr(said, "finished", said.finished + 1),
        )

    fake = ModuleType("wandb")
    fake.__spec__ = SimpleNamespace(name="wandb")  # type: ignore[assignment]
    parts: dict[str, Any] = {"init": init, "Artifact": Artifact, "Error": RuntimeError, "Settings": dict}
    parts |= {
        "Video": lambda file, format: f"video {Path(file).name}",
        "Image": lambda file: f"image {Path(file).name}",
    }
    for name, part in parts.items():
        setattr(fake, name, part)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return said


def test_rows_and_files_of_a_run_are_handed_on(tmp_path: Path, wandb: Recorded) -> None:
    run = RunFolder(tmp_path / "run", {"name": "mine"}, tensorboard=False, logger="wandb")
    run.begin()
    run.log(ROW)
    run.close()
    assert run.is_tracked  # until it is finished: what is made at the end comes after
    for name in ("play.mp4", "learning_curve.png", "policy.onnx"):
        (run.path / name).write_text("x")
    run.finish([run.path / name for name in ("play.mp4", "learning_curve.png", "policy.onnx", "policy.json")])
    run.finish()
    assert wandb.rows == [
        {"update": 1.0, "samples": 100.0, "lr": 0.5},
        {"play": "video play.mp4", "learning_curve": "image learning_curve.png"},
    ]
    assert wandb.files == ["policy.onnx"]
    assert wandb.finished == 1
    assert (wandb.begun[0]["config"], wandb.begun[0]["project"]) == ({"name": "mine"}, "pace")
    again = RunFolder(tmp_path / "run", {"name": "mine"}, False, first_update=1, logger="wandb")
    again.begin()
    again.abandon()
    assert wandb.begun[1]["id"] == wandb.begun[0]["id"]  # the same run there
    assert wandb.finished == 2


def test_without_a_logger_the_package_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    run = RunFolder(tmp_path / "run", {}, tensorboard=False)
    run.log(ROW)
    run.close()
    run.finish([run.path / "metrics.csv"])
    assert not run.is_tracked


def test_a_missing_package_names_the_extra_and_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracker, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"logger=wandb needs the package wandb: pip install .*wandb"):
        RunFolder(tmp_path / "run", {}, tensorboard=False, logger="wandb")
    with pytest.raises(ConfigError, match="logger must be null or wandb, not 'tensorboard'"):
        RunFolder(tmp_path / "run", {}, tensorboard=False, logger="tensorboard")
    assert list(tmp_path.iterdir()) == []


def test_a_server_that_wants_a_key_is_one_line(
    tmp_path: Path, wandb: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**given: Any) -> Any:
        raise RuntimeError("api_key not configured\n(no-tty)")

    monkeypatch.setattr(sys.modules["wandb"], "init", refuse)
    run = RunFolder(tmp_path / "run", {}, tensorboard=False, logger="wandb")
    with pytest.raises(
        ConfigError, match=r"logger=wandb: api_key not configured \(no-tty\) \(wandb login, or WANDB_MODE"
    ):
        run.begin()
    run.abandon()


def test_the_real_package_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    run = RunFolder(tmp_path / "run", {"name": "mine", "algo": {"lr": 0.1}}, tensorboard=False, logger="wandb")
    run.log(ROW)
    run.close()
    (run.path / "policy.onnx").write_text("x")
    run.finish([run.path / "policy.onnx"])
    assert len(list((run.path / "wandb").glob("offline-run-*/run-*.wandb"))) == 1
