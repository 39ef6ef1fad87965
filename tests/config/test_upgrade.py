"""What older versions saved: configurations and training state in today's form, from the files of the repository."""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from pace.config import upgrade
from pace.config.base import ConfigError, parse, to_dict
from pace.config.overrides import override_task
from pace.config.renamed import RENAMED_CHOICES
from pace.config.task import SPINS
from pace.config.training import TrainConfig, load_train_config
from pace.config.upgrade import FORMAT, upgrade_config, upgrade_state
from pace.rl.policies import load_policy
from pace.runs.checkpoint import META, load_checkpoint, read_meta
from pace.runs.queue import Run, check_settings
from pace.task.statistics import NAMES
from tests.helpers.saved import save_run


def old_config(**changes: Any) -> dict[str, Any]:
    """The default configuration as commit 43400ac saved it."""
    config = to_dict(load_train_config(["robot=t1_paper"]))
    config["robot"]["name"] = "t1"
    del config["out"]
    serve = {name: value for name, value in config["serve"].items() if name not in SPINS}
    config["serve"] = serve | {"spin": [0.0, 0.0]}
    return config | {"run_dir": "runs/old"} | changes


def test_run_dir_is_out() -> None:
    old = old_config()
    before = deepcopy(old)
    new = upgrade_config(old, 1)
    assert (new["out"], "run_dir" in new) == ("runs/old", False)
    assert parse(new, TrainConfig).out == "runs/old"
    assert old == before
    assert upgrade_config(new, FORMAT) == new


def test_renamed_choices_are_renamed_in_what_was_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RENAMED_CHOICES, "sensing", {"blurred": "wide"})
    old = old_config(curriculum=[{"samples": 1e6, "task": ["sensing=blurred", "reward.scale=0.3"]}])
    old["sensing"] = old["sensing"] | {"name": "blurred"}
    new = upgrade_config(old, 1)
    assert new["curriculum"][0]["task"] == ["sensing=wide", "reward.scale=0.3"]
    assert (new["sensing"]["name"], new["ball"]["name"]) == ("wide", "rubber")
    with pytest.raises(ConfigError, match="sensing=blurred is now sensing=wide"):
        override_task(load_train_config(), ["sensing=blurred"])
    with pytest.raises(ConfigError, match="sensing=blurred is now sensing=wide"):
        load_train_config(["sensing=blurred"])


def test_one_range_of_spin_is_that_of_each_axis() -> None:
    old = old_config(curriculum=[{"samples": 1e6, "task": ["serve.spin=[-9.0,9.0]", "sensing=wide"]}])
    old["serve"]["spin"] = [-5.0, 30.0]
    new = parse(upgrade_config(old, 1), TrainConfig)
    assert [getattr(new.serve, name) for name in SPINS] == [[-5.0, 30.0]] * 3
    assert new.curriculum[0].task == [*(f"serve.{name}=[-9.0,9.0]" for name in SPINS), "sensing=wide"]
    for odd in ({}, {"serve": 3, "curriculum": [None, {"task": [7]}]}):
        assert upgrade_config(odd, 2) == odd
    with pytest.raises(ConfigError, match=r"serve\.topspin=, serve\.sidespin=, serve\.corkscrew="):
        load_train_config(["serve.spin=[0.0,1.0]"])
    with pytest.raises(ConfigError, match=r"serve\.spin= is now one key an axis"):
        override_task(load_train_config(), ["serve.spin=[0.0,1.0]"])


@pytest.mark.parametrize("version", [2, 3])
def test_the_robot_of_before_is_the_papers(version: int) -> None:
    saved = old_config(curriculum=[{"samples": 1e6, "task": ["robot=t1", "robot.stall_ratio=2.0"]}])
    for name, expected in (("t1", "t1_paper"), ("mine", "mine")):
        saved["robot"]["name"] = name
        new = upgrade_config(saved, version)
        assert new["robot"] == saved["robot"] | {"name": expected}
        assert new["curriculum"][0]["task"] == ["robot=t1_paper", "robot.stall_ratio=2.0"]
        assert upgrade_config(saved, FORMAT) == saved


@pytest.mark.parametrize("policy", ["pace", "wide", "campaign"])
def test_published_policies_keep_their_robot(policy: str) -> None:
    """All numbers as they were saved, and those of a new robot with ``robot=t1``, with its limits of the solver."""
    saved = json.loads(Path("pretrained", policy, META).read_text())["config"]
    config = load_policy(Path("pretrained", policy)).config
    paper, t1 = (load_train_config([f"robot={name}"]) for name in ("t1_paper", "t1"))
    stall_ratio = saved["robot"].get("stall_ratio", 0.0)
    max_speed = [group.get("max_speed", 0.0) for group in saved["robot"]["joint_groups"]]
    expected = to_dict(paper.robot) | {"stall_ratio": stall_ratio}
    for group, speed in zip(expected["joint_groups"], max_speed, strict=True):
        group["max_speed"] = speed
    assert to_dict(config.robot) == expected
    limits = ("solver_iterations", "line_search_iterations")
    assert [getattr(config.engine, name) for name in limits] == [saved["engine"][name] for name in limits] == [10, 10]
    changed = override_task(config, ["robot=t1"])
    assert changed.robot == t1.robot
    assert changed.engine == replace(config.engine, line_search_iterations=t1.engine.line_search_iterations)
    assert t1.engine.line_search_iterations == 15
    assert override_task(config, ["robot=t1", "engine.line_search_iterations=3"]).engine.line_search_iterations == 3


def test_upgrades_run_in_order_and_only_where_they_are_due(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [(number, lambda state, number=number: state["seen"].append(number)) for number in (3, 2, 4)]
    monkeypatch.setattr(upgrade, "STATE_UPGRADES", steps)
    assert upgrade_state({"seen": []}, 2) == {"seen": [3, 4]}
    assert upgrade_state({"seen": []}, 1) == {"seen": [2, 3, 4]}
    assert upgrade_state({"seen": []}, 4) == {"seen": []}


def old_env(worlds: int = 3) -> dict[str, torch.Tensor]:
    """The tensors of an environment of format 2 that the upgrades read."""
    flags = torch.arange(worlds) % 2 == 0
    return {
        "sensing._line": torch.rand(worlds, 2, 8),
        "sensing._delay": torch.full((worlds,), 0.5),
        "worlds.drawn.ball.mass": torch.full((worlds,), 0.0027),
        "worlds.drawn.engine.effort_scale": torch.full((worlds,), 0.97),
        "worlds.event.edge": torch.zeros(worlds, dtype=torch.int32),
        "worlds.event.edge_time": torch.full((worlds,), torch.inf),
        "statistics.sums": torch.arange(16.0),
        "worlds.position": torch.rand(worlds, 3),
        "game.ends.over": flags,
        "game.ends.outcome": flags.int(),
        "game.target.something_to_hit": torch.ones_like(flags),
        "track.something_to_hit": flags,
    }


def test_a_state_of_format_2_gets_what_the_true_world_keeps() -> None:
    old = old_env()
    env = upgrade_state({"processes": [{"env": dict(old), "random": {}}]}, 2)["processes"][0]["env"]
    padded = env["sensing._line"]
    assert torch.equal(padded[..., :8], old["sensing._line"])
    assert padded[..., 8:].tolist() == [[[0.0, 1.0]] * 2] * 3
    assert env["sensing.ball_age"].tolist() == pytest.approx([0.01] * 3)
    assert env["track.age"].tolist() == env["sensing.ball_age"].tolist()
    assert env["sensing.ball_new"].all()
    assert env["env.predictor_valid"].tolist() == [True, False, True]
    assert env["worlds.drawn.ball.paddle_tangential_restitution"].tolist() == [0.0] * 3
    assert env["worlds.drawn.engine.speed_scale"].tolist() == [1.0] * 3
    assert env["worlds.drawn.engine.joint_friction"].tolist() == [0.0] * 3
    assert env["worlds.in_view"].all()
    assert not env["game.pause.waiting"].any()
    assert env["serves.sampled"].shape == (3, 9)
    assert env["worlds.drawn.backlash"].tolist() == [0.0] * 3
    assert env["worlds.drawn.paddle_error"].tolist() == [[0.0] * 5] * 3
    assert env["worlds.event.body"].tolist() == [0] * 3
    assert env["worlds.event.body_time"].isinf().all()
    assert env["statistics.sums"].tolist() == [*range(16), 0, 0, 0]


def test_a_state_of_format_4_gets_the_count_of_the_free_hand() -> None:
    saved = old_env() | {"statistics.sums": torch.arange(18.0), "serves.sampled": torch.rand(3, 9)}
    env = upgrade_state({"processes": [{"env": saved}]}, 4)["processes"][0]["env"]
    counts = dict(zip(NAMES, env["statistics.sums"].tolist(), strict=True))
    assert (counts["outcome/table_touch"], counts["outcome/free_hand"]) == (17.0, 0.0)


@pytest.mark.parametrize("robot", ["t1_paper", "t1_29dof"])
def test_a_saved_robot_has_the_hands_of_its_mjcf(robot: str) -> None:
    now = to_dict(load_train_config([f"robot={robot}"]))
    old = deepcopy(now)
    for key in ("paddle_hand", "free_hand"):
        del old["robot"][key]
    assert upgrade_config(old, 3)["robot"] == now["robot"]


@pytest.mark.parametrize("policy", sorted(path.name for path in Path("pretrained").glob("*/")))
def test_published_policies_are_read(policy: str) -> None:
    folder = Path("pretrained", policy)
    if json.loads((folder / META).read_text())["format"] == 1:
        assert "run_dir" in (folder / META).read_text()
    config = read_meta(folder)["config"]
    assert (config["out"], "run_dir" in config) == (None, False)
    assert load_policy(folder).config.out is None


def test_a_saved_file_says_its_format(tmp_path: Path) -> None:
    folder = save_run(tmp_path) / "checkpoints" / "update_00000003"
    assert json.loads((folder / META).read_text())["format"] == FORMAT


def test_an_old_checkpoint_is_upgraded_wherever_it_is_read(tmp_path: Path) -> None:
    folder = save_run(tmp_path) / "checkpoints" / "update_00000003"
    meta = json.loads((folder / META).read_text())
    meta |= {"format": 1, "config": old_config()}
    (folder / META).write_text(json.dumps(meta))
    assert load_checkpoint(tmp_path).config["out"] == "runs/old"
    check_settings(Run(tmp_path, ("robot=t1_paper",), 100.0))  # the same settings, but for the folder


def test_a_state_of_format_5_gets_the_stamps_of_the_base_and_a_good_serve() -> None:
    worlds = {"sensing._delay": torch.tensor([0.5, 1.0]), "game.ends.over": torch.zeros(2, dtype=torch.bool)}
    worlds["serves.sampled"] = torch.rand(2, 9)
    filmed = worlds | {"sensing.mocap._base_age": torch.tensor([0.03, 0.09])}
    envs = [
        process["env"] for process in upgrade_state({"processes": [{"env": worlds}, {"env": filmed}]}, 5)["processes"]
    ]
    assert [env["sensing.base_age"].tolist() for env in envs] == [
        pytest.approx([0.01, 0.02]),
        pytest.approx([0.03, 0.09]),
    ]
    assert all(env["sensing.base_new"].all() for env in envs)
    assert "sensing.mocap._base_age" not in envs[1]
    assert torch.equal(envs[0]["serves.good"], worlds["serves.sampled"])
    assert envs[0]["serves.good_about"].shape == (2, 3)
