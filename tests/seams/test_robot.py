"""A robot from outside: an MJCF and a YAML, and nothing else. It is the T1 with a neck that turns."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from pace.config.base import ConfigError, config_dir
from pace.config.training import load_train_config
from pace.deploy.__main__ import main as export
from pace.evaluation.__main__ import main as evaluate
from pace.rl.policies import load_policy
from pace.rl.train import main as train
from pace.sim.robot import build_model
from pace.sim.robot_spec import ASSETS, RobotSpec
from tests.helpers.outside import SMALL, command

JOINTS = 22
NECK = '<body name="H1" pos="0.0625 0 0.243">'
ACTUATORS = "<actuator>\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """robot/nodding.yaml and nodding.xml, outside of the package."""
    outside = tmp_path_factory.mktemp("outside")
    xml = (ASSETS / "t1_paddle.xml").read_text()
    assert NECK in xml
    assert ACTUATORS in xml
    xml = xml.replace(NECK, f'{NECK}\n<joint name="Neck" axis="0 0 1" range="-0.5 0.5"/>')
    xml = xml.replace(ACTUATORS, f'{ACTUATORS}<position name="Neck" joint="Neck" kp="5" kv="1"/>\n')
    (outside / "nodding.xml").write_text(xml)
    text = (config_dir() / "robot" / "t1.yaml").read_text().replace("name: t1\n", "name: nodding\n")
    text = text.replace("model: t1_paddle.xml", f"model: {outside / 'nodding.xml'}")
    neck = "  - {match: [Neck], kp: 5.0, kd: 1.0, effort: 4.0, max_speed: 9.0}"
    text = text.replace("joint_groups:", f"joint_groups:\n{neck}\n#")
    (outside / "robot").mkdir()
    (outside / "robot" / "nodding.yaml").write_text(text)
    return outside


@pytest.fixture(scope="module")
def run(folder: Path) -> Path:
    """A run of two updates with the robot."""
    out = folder / "run"
    chosen = ("--config-dir", str(folder), "robot=nodding", "observation=memory", "predictor.frames=5")
    assert command(train, f"out={out}", *chosen, *SMALL) == 0
    return out


def test_its_parts_are_those_of_its_mjcf(run: Path) -> None:
    robot = load_policy(run).config.robot
    spec = RobotSpec.of(robot)
    assert spec.joints[0] == "Neck"
    assert len(spec.joints) == JOINTS
    assert spec.arm == ("Right_Shoulder_Pitch", "Right_Shoulder_Roll", "Right_Elbow_Pitch", "Right_Elbow_Yaw")
    config = load_policy(run).config
    model = build_model(robot, config.engine, config.ball.table)
    assert (model.nq, model.nv, model.nu) == (7 + JOINTS, 6 + JOINTS, JOINTS)
    assert model.actuator_forcerange[0].tolist() == [-4.0, 4.0]
    np.testing.assert_allclose(model.actuator_gainprm[0, [4, 6]], [5.0, 1.0])


@pytest.mark.slow
def test_its_policy_plays_and_is_evaluated(folder: Path, run: Path) -> None:
    policy = load_policy(run)
    env = policy.make_env(2, "cpu")
    assert env.action_spec.shape == (2, JOINTS)
    assert policy(env.policy_observation).shape == (2, JOINTS)
    env.advance(torch.zeros(2, JOINTS))
    columns = env.policy_layout["estimated_joint_position"]
    assert columns.stop - columns.start == JOINTS
    assert bool(env.policy_observation.isfinite().all())
    table = ("rows=[mixed]", "serves=2", "num_worlds=2", "warmup_serves=0", "physics_dt=0.01", "progress=false")
    assert command(evaluate, str(run), f"out={folder / 'table'}", "engine.threads=1", "first_ball=[]", *table) == 0
    assert json.loads((folder / "table" / "evaluation.json").read_text())["rows"][0]["serves"] >= 2


@pytest.mark.slow
def test_its_policy_is_exported(folder: Path, run: Path) -> None:
    onnx = pytest.importorskip("onnx")
    assert command(export, str(run), f"out={folder / 'file'}", "check_worlds=2", "check_steps=5") == 0
    stored = {item.key: item.value for item in onnx.load(folder / "file" / "policy.onnx").metadata_props}
    assert json.loads(stored["joint_names"])[0] == "Neck"
    assert len(json.loads(stored["nominal_pose"])) == JOINTS


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("robot.model=no_such.xml", "robot.model: no file no_such.xml"),
        ("robot.paddle_site=racket", "robot.paddle_site: t1_paddle.xml has no site racket"),
        ("robot.foot_sites=[left_foot,hoof]", "robot.foot_sites: t1_paddle.xml has no site hoof"),
        ("robot.arm=[Wing]", "robot.arm: no joint of t1_paddle.xml has Wing in its name"),
        ("robot.groups.ankles=[Fin]", "robot.groups.ankles: no joint of t1_paddle.xml has Fin in its name"),
        ("robot.foot_sites=[left_foot]", "must name a left and a right sole"),
        ("+robot.groups.tail=[Waist]", "robot.groups: no reward term sums over tail"),
    ],
)
def test_a_part_that_is_not_there_is_one_clear_error(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        RobotSpec.of(load_train_config([override]).robot)


def test_an_mjcf_that_is_none_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "broken.xml").write_text("<mujoco>")
    with pytest.raises(ConfigError, match=r"robot.model .*broken.xml: "):
        RobotSpec.of(load_train_config([f"robot.model={tmp_path / 'broken.xml'}"]).robot)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<geom name="paddle" ', '<geom name="bat" ', "the blade must be a geom named paddle"),
        (
            '<contact name="right_foot_force"',
            '<contact name="right_foot_touch"',
            "its sensors must be the force on each",
        ),
    ],
)
def test_an_mjcf_without_a_needed_part_is_one_clear_error(tmp_path: Path, old: str, new: str, message: str) -> None:
    xml = (ASSETS / "t1_paddle.xml").read_text()
    assert old in xml
    for name in ("geom1", "geom2"):  # what refers to the paddle
        xml = xml.replace(f'{name}="paddle"', f'{name}="bat"') if "bat" in new else xml
    (tmp_path / "odd.xml").write_text(xml.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        RobotSpec.of(load_train_config([f"robot.model={tmp_path / 'odd.xml'}"]).robot)


def test_the_colours_of_the_blade_are_optional(tmp_path: Path) -> None:
    lines = (ASSETS / "t1_paddle.xml").read_text().splitlines()
    (tmp_path / "plain.xml").write_text("\n".join(line for line in lines if 'name="paddle_front"' not in line))
    config = load_train_config([f"robot.model={tmp_path / 'plain.xml'}"])
    assert build_model(config.robot, config.engine, config.ball.table, visual=True).nu == len(
        RobotSpec.of(config.robot).joints
    )
