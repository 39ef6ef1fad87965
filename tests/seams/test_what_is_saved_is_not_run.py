"""Import paths in saved runs and policies: loading, playing, evaluating and exporting them imports nothing."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pace.config.base import ConfigError
from pace.deploy.__main__ import main as export
from pace.evaluation.__main__ import main as evaluate
from pace.rl.policies import load_policy, load_predictor
from pace.runs.checkpoint import META, CheckpointError
from pace.runs.checkpoint_folders import list_checkpoints
from tests.helpers.outside import command, stranger, write_module
from tests.helpers.saved import save_run

EVIL = """
    from pathlib import Path
    Path(__file__).with_name("it_ran").touch()
    def anything(*arguments): ...
"""
PATHS = ("outside_evil:anything", "os:system")


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    write_module(tmp_path / "outside", "outside_evil", EVIL)
    with stranger(tmp_path / "outside"):
        yield tmp_path
    assert not (tmp_path / "outside" / "it_ran").exists()


def planted(folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A saved run whose configuration was changed by hand."""
    run = save_run(folder / "run")
    file = list_checkpoints(run)[-1] / META
    saved = json.loads(file.read_text())
    change(saved["config"])
    saved["config"]["plugins"] = ["outside_evil", "os"]
    file.write_text(json.dumps(saved))
    return run


@pytest.mark.slow
@pytest.mark.parametrize("path", PATHS)
def test_a_reward_is_not_even_looked_for(folder: Path, path: str) -> None:
    def change(config: dict[str, Any]) -> None:
        config["reward"]["terms"]["evil"] = {"weight": 1.0, "params": {}, "function": path}
        config["curriculum"] = [{"samples": 1.0, "task": [f"reward.terms.fall.function={path}"]}]

    run = planted(folder, change)
    policy = load_policy(run)
    policy.make_env(2, "cpu", 1, ["engine.threads=1"]).advance(policy.make_env(2, "cpu").task_state.action)
    table = ("rows=[short]", "serves=4", "num_worlds=4", "engine.threads=1", "progress=false", "physics_dt=0.01")
    table += ("first_ball=[]",)
    assert command(evaluate, str(run), f"out={folder / 'table'}", *table) == 0
    with pytest.raises(ConfigError, match=r"reward.terms.\w+.function: .*was not named"):
        policy.make_env(2, "cpu", rewards=True)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    ("group", "key"), [("algo", "algorithm"), ("predictor", "features"), ("observation", "policy")]
)
def test_a_network_is_one_error(
    folder: Path, group: str, key: str, path: str, capfd: pytest.CaptureFixture[str]
) -> None:
    run = planted(folder, lambda config: config[group].update({key: [path] if key == "policy" else path}))
    with pytest.raises(CheckpointError, match=rf"'{path}' is not of pace, .*plugins=\[{path.split(':')[0]}\]"):
        load_policy(run)
    if group == "predictor":
        with pytest.raises(CheckpointError, match="was not named"):
            load_predictor(run)
    for main in (evaluate, export):
        assert command(main, str(run)) == 1
        lines = [line for line in capfd.readouterr().err.splitlines() if not line.startswith("Warp")]
        assert len(lines) == 1
        assert "plugins=[" in lines[0]


@pytest.mark.parametrize("path", PATHS)
def test_an_engine_is_one_error(folder: Path, path: str) -> None:
    policy = load_policy(planted(folder, lambda config: config["engine"].update(name=path)))
    with pytest.raises(ConfigError, match="was not named"):
        policy.make_env(2, "cpu")
