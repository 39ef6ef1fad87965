"""Serves and balls from outside: a YAML file each in the user's own folder, for every command (``--config-dir``)."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pace.config.base import ConfigError, also_from, compose
from pace.config.names import choices
from pace.config.overrides import override_task
from pace.evaluation.__main__ import main as evaluate
from pace.evaluation.sweep import ball_presets
from pace.rl.policies import load_policy
from pace.rl.train import main as train
from pace.runs.queue import Run
from tests.helpers.outside import SMALL, command
from tests.helpers.saved import save_run

LOB = "defaults: [short]\nname: lob\nvx: [-4.6, -4.2]\nvz: [2.6, 3.0]\n"
HEAVY = "defaults: [rubber]\nname: heavy\nmass: 0.004\n"


@pytest.fixture(params=["mine", "it's, mine = yours"])
def folder(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """serve/lob.yaml and ball/heavy.yaml."""
    mine = tmp_path / request.param
    for group, text in (("serve/lob", LOB), ("ball/heavy", HEAVY)):
        (mine / group).parent.mkdir(parents=True)
        (mine / f"{group}.yaml").write_text(text)
    return mine


def test_a_saved_policy_is_evaluated_with_them(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder.parent)
    run = str(save_run(tmp_path / "run"))
    table = ("rows=[lob]", "serves=4", "num_worlds=4", "physics_dt=0.01", "engine.threads=1", "progress=false")
    chosen = (*table, "ball=heavy", "first_ball=[]", f"out={tmp_path / 'table'}")
    assert command(evaluate, run, "--config-dir", folder.name, *chosen) == 0
    written = json.loads((tmp_path / "table" / "evaluation.json").read_text())
    assert [row["serve"] for row in written["rows"]] == ["lob"]
    assert written["task"]["ball"]["mass"] == 0.004
    assert command(evaluate, run, *chosen) == 2
    assert "serve/lob does not exist" in capfd.readouterr().err


def test_they_are_known_in_the_block_only(folder: Path, tmp_path: Path) -> None:
    saved = load_policy(save_run(tmp_path / "run")).config
    with also_from([folder]):
        task = override_task(saved, ["serve=lob", "ball=heavy"])
        assert (task.serve.vx, task.serve.x, task.ball.mass) == ([-4.6, -4.2], [1.35, 1.35], 0.004)
        assert "lob" in choices("serve")
        assert "heavy" in ball_presets()  # the sweep and the page offer it
        arguments = Run(tmp_path / "other", ("serve=lob",), 64.0).arguments()  # of an ablation
    own = [argument for argument in arguments if argument.startswith("hydra.")]
    assert compose("train", [*own, "serve=lob"]).serve.name == "lob"
    assert "lob" not in choices("serve")
    with pytest.raises(ConfigError, match="ball/heavy does not exist"):
        override_task(saved, ["ball=heavy"])


def test_a_stage_of_the_curriculum_may_name_one(folder: Path, tmp_path: Path) -> None:
    stage = "curriculum=[{samples: 32, task: ['serve=lob']}]"
    assert command(train, f"out={tmp_path / 'run'}", "--config-dir", str(folder), stage, *SMALL) == 0
