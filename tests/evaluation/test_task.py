"""What an evaluation plays: the table's task for every policy, its own, and the referee's rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pace.config.base import ConfigError, also_from, compose, parse, to_dict
from pace.config.commands import EvaluateConfig
from pace.config.overrides import override_task
from pace.config.realities import load_realities
from pace.config.training import load_train_config
from pace.evaluation import evaluate
from pace.evaluation.sweep import variations
from pace.evaluation.task import differences, own_pauses, policy_on, table_task, task_line
from pace.rl.policies import TaskPolicy, built_in_policy, load_policy
from pace.sim.robot import joint_gains


def config_of(*arguments: str) -> EvaluateConfig:
    return parse(compose("evaluate", ["policy=zero", *arguments]), EvaluateConfig)


@pytest.mark.parametrize("name", sorted(path.name for path in Path("pretrained").glob("*/")))
def test_every_policy_plays_the_same_table(name: str) -> None:
    usual, played = load_train_config(), table_task(load_policy(Path("pretrained", name)).config)
    for part in ("ball", "sensing", "randomization"):
        assert getattr(played, part) == getattr(usual, part), part
    for key in ("model", "armature", "stall_ratio"):
        assert getattr(played.robot, key) == getattr(usual.robot, key)
    assert (played.serve.pause, played.serve.first_pause) == ([0.0, 0.0], [0.0, 0.0])
    assert differences(load_train_config(), played) == []


def test_the_controller_stays_the_policys_own() -> None:
    own = load_train_config(["robot.action_scale=0.4", "robot.nominal_pose.Left_Elbow_Yaw=0.1", "sensing=wide"])
    stiff = [replace(group, kp=2.0 * group.kp, effort=1.0) for group in own.robot.joint_groups]
    own = replace(own, robot=replace(own.robot, joint_groups=stiff))
    played, usual = table_task(own), load_train_config()
    assert (played.robot.action_scale, played.robot.nominal_pose["Left_Elbow_Yaw"]) == (0.4, 0.1)
    kp, kd, effort = joint_gains(usual.robot)
    assert joint_gains(played.robot).tolist() == [(2.0 * kp).tolist(), kd.tolist(), effort.tolist()]
    assert played.sensing.name == "paper"


def test_a_robot_with_other_joints_stays() -> None:
    own = load_train_config(["robot=t1_29dof", "ball=paper"])
    played = table_task(own)
    assert played.robot == own.robot
    assert played.ball.name == "rubber"


def test_own_is_the_saved_task() -> None:
    policy = built_in_policy("zero", 1)
    assert policy_on("own", policy) is policy
    mine = replace(policy, config=load_train_config(["ball=paper"]))
    assert policy_on("table", mine).config.ball.name == "rubber"


def test_one_line_says_how_the_tasks_differ() -> None:
    own = load_train_config(["ball=paper", "sensing.noise_scale=[2.0,2.0]"])
    played = table_task(own)
    line = task_line("table", own, played)
    assert line.startswith("task=table: robot=t1, ball=rubber, randomization=moderate, sensing=paper; task=own has ")
    assert line.endswith("ball=paper, sensing.noise_scale")
    assert task_line("table", played, played).endswith("task=own is the same")
    assert task_line("own", own, own).startswith("task=own: robot=t1, ball=paper")


PAUSED = [
    "serve.pause=[0.5,3.0]",
    "serve.first_pause=[0.0,1.5]",
    "serve.pause_ball={lies: 0.5, carried: 0.0, hidden: 0.5}",
]


def test_the_line_tells_pauses_and_spin_of_the_policys_own_serves() -> None:
    own = load_train_config([*PAUSED, "serve.sidespin=[-20,20]"])
    played = table_task(own)
    line = task_line("table", own, played)
    assert "serve.pause" not in line.split(";")[0]  # the table has none
    assert line.split("; ")[1:] == [
        "task=own has serve.pause, serve.first_pause, serve.pause_ball",
        "trained with serve.sidespin, which the rows set",
    ]
    assert task_line("own", own, own) == (
        "task=own: robot=t1, ball=rubber, randomization=moderate, sensing=paper, serve.pause=[0.5,3] s, "
        "serve.first_pause=[0,1.5] s; trained with serve.sidespin, which the rows set"
    )


def test_the_line_tells_other_launches_of_the_policys_own_serves() -> None:
    machine, wide = load_train_config(["serve=machine"]), load_train_config(["serve.y=[-0.3,0.3]"])
    assert task_line("own", machine, machine).endswith("; trained with serve=machine, which the rows set")
    assert task_line("table", wide, table_task(wide)).endswith("; trained with serve.y, which the rows set")


@pytest.mark.parametrize("row", ["long", "machine"])
def test_a_row_of_the_own_task_has_the_policys_pauses_and_the_rows_launches(row: str) -> None:
    own = load_train_config([*PAUSED, "serve.sidespin=[-20,20]"])
    usual, overrides = load_train_config([f"serve={row}"]).serve, own_pauses("own", own)
    played = override_task(own, [f"serve={row}", *overrides]).serve
    assert (played.pause, played.first_pause, played.pause_ball) == (
        [0.5, 3.0],
        [0.0, 1.5],
        {"lies": 0.5, "carried": 0.0, "hidden": 0.5},
    )
    kept = {"pause": usual.pause, "first_pause": usual.first_pause, "pause_ball": usual.pause_ball}
    assert replace(played, **kept) == usual
    assert own_pauses("table", own) == own_pauses("own", load_train_config()) == []
    later = override_task(own, [f"serve={row}", *overrides, "serve.pause=[5.0,5.0]"]).serve
    assert later.pause == [5.0, 5.0]  # the command line wins


def test_the_own_pauses_reach_the_rows(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    own = replace(built_in_policy("zero", 1), config=load_train_config(PAUSED))
    monkeypatch.setattr(evaluate, "choose_policy", lambda config: own)
    seen: list[list[float]] = []

    def play(policy: TaskPolicy, serve: str, *arguments: object) -> None:
        overrides = arguments[4]
        assert isinstance(overrides, list | tuple)
        seen.append(override_task(policy.config, [f"serve={serve}", *overrides]).serve.pause)
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "evaluate_row", play)
    for task in ("own", "table"):
        with pytest.raises(KeyboardInterrupt):
            evaluate.evaluate_from_config(compose("evaluate", ["policy=zero", f"task={task}", "rows=[long]"]))
    assert seen == [[0.5, 3.0], [0.0, 0.0]]
    assert "task=own has serve.pause" in capsys.readouterr().out


def test_serve_values_change_every_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """The serve of each row and cell as the environment gets it."""
    seen: list[tuple[str, list[float]]] = []

    def play(policy: TaskPolicy, serve: str, *arguments: object) -> None:
        overrides = arguments[4]
        assert isinstance(overrides, list | tuple)
        task = override_task(policy.config, [f"serve={serve}", *overrides])
        seen.append((task.serve.name, task.serve.topspin))
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "evaluate_row", play)
    for row in ("long", "short"):
        composed = compose("evaluate", ["policy=zero", f"rows=[{row}]", "overrides=['serve.topspin=[30.0,30.0]']"])
        with pytest.raises(KeyboardInterrupt):
            evaluate.evaluate_from_config(composed)
    assert seen == [("long", [30.0, 30.0]), ("short", [30.0, 30.0])]


def test_worlds_follow_from_balls_a_world() -> None:
    assert config_of("serves=5000").worlds_for(5000) == 250
    assert config_of().worlds_for(1000) == 50
    assert config_of("num_worlds=512").worlds_for(5000) == 512
    assert config_of("num_worlds=512").worlds_for(100) == 100
    assert config_of("balls_per_world=3").worlds_for(10) == 4


@pytest.mark.long
def test_the_referees_rows_change_what_they_name() -> None:
    task = load_train_config()
    cells = {cell.value: cell for cell in variations(task, config_of().variations, "referee")}
    before = to_dict(task)

    def changed(label: str) -> dict[str, object]:
        after = to_dict(override_task(task, cells[label].overrides))
        return {
            f"{part}.{key}": value
            for part, values in after.items()
            if isinstance(values, dict)
            for key, value in values.items()
            if before[part][key] != value
        }

    assert changed("topspin 120") == {"serve.topspin": [120, 120]}
    assert changed("all torques -30 %") == {"randomization.effort_scale": [0.7, 0.7]}
    assert changed("one control step later") == {"randomization.actuator_delay": [0.020, 0.026]}
    assert changed("0.5 to 3 s, ball out of view") == {
        "serve.pause": [0.5, 3.0],
        "serve.pause_ball": {"lies": 0.0, "carried": 0.0, "hidden": 1.0},
    }
    assert {"sensing.mocap", "randomization.backlash"} <= set(changed("mild"))


def test_the_referees_rows_are_those_that_were_asked_for() -> None:
    """The table of what an independent referee found: each has a row but a human's serve and elite rally balls."""
    kinds = load_realities("referee")
    rows = {kind: list(named) for kind, named in kinds.items()}
    assert set(rows) == {"pauses", "spin", "serve", "rubber", "sensing", "acting", "place", "mixture"}
    assert rows["spin"] == [
        *(f"topspin {spin}" for spin in (30, 60, 120)), "backspin 30", "backspin 60", "sidespin +40", "sidespin -40"
    ]  # fmt: skip
    assert rows["mixture"] == ["mild", "hard"]
    assert {"0.5 to 3 s, ball lies in view", "0.5 to 3 s, ball out of view", "0.5 to 3 s, ball carried about"} <= set(
        rows["pauses"]
    )
    assert {"flat and fast, vz 0.8 to 1.4", "slow, vx -5.2 to -4.7", "from y -0.5 to 0.5", "from z 1.2"} <= set(
        rows["serve"]
    )
    assert {"to the left, vy 0.2 to 0.5", "to the left, vy 0.5 to 0.8"} <= set(rows["serve"])
    assert {"5 % of steps without a frame", "20 % of steps without a frame", "delay 60 ms"} <= set(rows["sensing"])
    assert "delay jitters, 4 to 30 ms a frame" in rows["sensing"]
    assert {"one control step later", "all torques -30 %", "ankle torque -30 %"} <= set(rows["acting"])
    assert {"paddle 3 degrees and 1 cm off", "floor friction 0.4"} <= set(rows["place"])


@pytest.mark.long
def test_every_row_of_the_referee_is_played_and_none_is_the_task_as_it_is() -> None:
    task = load_train_config()
    chosen = config_of().variations
    policy = built_in_policy("zero", 1, None, "cpu")
    for cell in variations(task, chosen, "referee")[len(variations(task, chosen)) :]:
        assert to_dict(override_task(task, cell.overrides)) != to_dict(task), cell.value
        env = policy.make_env(2, "cpu", overrides=cell.overrides)
        for _ in range(5):
            env.advance(policy(env.policy_observation))
        assert env.first_bad() is None, cell.value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("spin: [1]", "must map kinds"),
        ("- a", "must map kinds"),
        ("spin: {top: serve.topspin=1}", "row 'spin, top': needs a list"),
        ("spin: {top: [3]}", "row 'spin, top': needs a list"),
        ("spin: {top: []}", "row 'spin, top': needs a list"),
        ("spin: {top: [a", "is no YAML"),
    ],
)
def test_a_file_of_another_form_names_its_row(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "realities").mkdir()
    (tmp_path / "realities" / "mine.yaml").write_text(text)
    with also_from([tmp_path]), pytest.raises(ConfigError, match=message):
        load_realities("mine")


def test_a_row_that_does_not_fit_is_named(tmp_path: Path) -> None:
    (tmp_path / "realities").mkdir()
    (tmp_path / "realities" / "mine.yaml").write_text("spin: {top: ['serve.topspn=[1,1]']}")
    with also_from([tmp_path]), pytest.raises(ConfigError, match=r"reality=mine, spin, top: .*topspn"):
        variations(load_train_config(), config_of().variations, "mine")
