"""Randomisation: its ranges cover the ball presets, and each draw reaches its own world, on both engines."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest
import torch
from torch import Tensor

from pace.config.ball import BallConfig
from pace.config.base import ConfigError
from pace.config.training import TrainConfig, load_train_config
from pace.sim.ball.ball import ball_preset
from pace.sim.randomization import BALL_LIMITS, SAMPLED_BALL_PARAMS
from pace.sim.robot import joint_armature, joint_gains, motor_lines
from pace.sim.worlds import Worlds
from pace.studies.ball_reference import measured_drag, measured_lift
from pace.studies.ball_trials import PRESETS
from tests.helpers.robot import JOINT_NAMES

WORLDS = 3
EVERY = torch.ones(WORLDS, dtype=torch.bool)
TABLE_SPEEDS = np.linspace(2.0, 3.4, 16)  # m/s along the normal: bounces of serves
PADDLE_SPEEDS = np.linspace(3.0, 12.0, 16)  # strikes
SLIPS = np.linspace(0.0, 12.0, 16)  # m/s at the paddle: strikes, with the spin of serves
FLYING = np.linspace(3.5, 8.0, 10)  # m/s, serves and returns
MEASURED_DRAG = measured_drag(FLYING, np.zeros(10))
MEASURED_LIFT = 8 / 3 * measured_lift(FLYING, np.full(10, 30.0))  # C_L over S, at the spin that a bounce gives
#: What the sources of configs/robot/t1.yaml say of a motor, by part of its joint's name: efforts (N m), no-load speeds
#: (rad/s) and armatures (kg m^2); t1_paper's are read from its file.
SOURCES = {
    "Shoulder_Pitch": ((18,), (18, 7.33), (0.05, 0.0283)),
    "Shoulder_Roll": ((18,), (18, 7.33), (0.0283,)),
    "Elbow_Pitch": ((18,), (18, 7.33), (0.05, 0.0283)),
    "Elbow_Yaw": ((18,), (18, 7.33), (0.0283,)),
    "Waist": ((25,), (7.1, 12.57), (0.0478,)),
    "Hip_Pitch": ((45,), (15.2, 16.76), (0.0524,)),
    "Hip_Roll": ((25,), (7.1, 12.57), (0.0478,)),
    "Hip_Yaw": ((25,), (7.1, 12.57), (0.0478,)),
    "Knee": ((60,), (14.7, 12.57), (0.0636,)),
    "Ankle_Pitch": ((24,), (12.9, 18.8), (0.05, 0.068)),
    "Ankle_Roll": ((15,), (12.9, 12.4), (0.05, 0.068)),
}


@lru_cache
def wide_config() -> TrainConfig:
    return load_train_config(["randomization=wide"])


def drawn_range(name: str) -> tuple[float, float]:
    """Lowest and highest value of a ball parameter under ``randomization=wide``."""
    config = wide_config()
    range_name, scales = SAMPLED_BALL_PARAMS[name]
    nominal, (low, high) = getattr(config.ball, name), getattr(config.randomization, range_name)
    ends = np.array([low, high]) * nominal if scales else np.array([low, high]) + nominal
    low, high = ends.clip(*BALL_LIMITS.get(name, (0.0, np.inf)))
    return float(low), float(high)


def assert_covered(name: str, value: np.ndarray | float, slope_effect: np.ndarray | float = 0.0) -> None:
    low, high = drawn_range(name)
    assert np.all(low + slope_effect <= value), name
    assert np.all(value <= high + slope_effect), name


@pytest.mark.parametrize("preset", PRESETS)
def test_wide_covers_every_preset(preset: str) -> None:
    ball: BallConfig = ball_preset(preset)
    rubber = wide_config().ball
    assert rubber.name == "rubber"
    thickness = ball.air_density / rubber.air_density  # the draws have rubber's air
    assert_covered("mass", ball.mass)
    assert rubber.drag_coefficient == rubber.magnus_coefficient == 0.0
    assert_covered("table_drag", thickness * (ball.table_drag + ball.drag_coefficient / MEASURED_DRAG))
    assert_covered("table_lift", thickness * (ball.table_lift + ball.magnus_coefficient / MEASURED_LIFT))
    assert_covered("table_tangential_restitution", ball.table_tangential_restitution)
    assert_covered("paddle_drilling_loss", ball.paddle_drilling_loss)
    springing = ball.paddle_tangential_restitution - ball.paddle_tangential_restitution_slope * SLIPS
    assert_covered("paddle_tangential_restitution", springing, -rubber.paddle_tangential_restitution_slope * SLIPS)
    for surface, speeds in (("table", TABLE_SPEEDS), ("paddle", PADDLE_SPEEDS)):
        assert_covered(f"{surface}_friction", getattr(ball, f"{surface}_friction"))
        restitution, slope = (getattr(ball, f"{surface}_restitution{end}") for end in ("", "_slope"))
        own_slope = getattr(rubber, f"{surface}_restitution_slope")
        assert_covered(f"{surface}_restitution", restitution - slope * speeds, -own_slope * speeds)


def motors(name: str) -> dict[str, np.ndarray]:
    """Effort, no-load speed and armature (J,) of a robot of configs/robot."""
    robot = load_train_config([f"robot={name}"]).robot
    lines = motor_lines(robot)
    assert lines is not None
    return {"effort": joint_gains(robot)[2], "speed": lines[0], "armature": joint_armature(robot)}


def test_wide_covers_every_source_of_the_motors() -> None:
    ranges, t1, paper = wide_config().randomization, motors("t1"), motors("t1_paper")
    for index, joint in enumerate(JOINT_NAMES):
        source = next(numbers for part, numbers in SOURCES.items() if part in joint)
        for (name, nominal), known in zip(t1.items(), source, strict=True):
            low, high = (nominal[index] * end for end in getattr(ranges, f"{name}_scale"))
            assert nominal[index] in known
            for value in (*known, paper[name][index]):
                assert low <= value <= high, (joint, name, value)


def test_wide_keeps_friction_positive() -> None:
    assert drawn_range("table_friction")[0] > 0.1
    assert drawn_range("paddle_friction")[0] > 0.1


@pytest.fixture(scope="module", params=["native", "mjwarp"])
def worlds(request: pytest.FixtureRequest) -> Worlds:
    """Clean worlds on each engine; ``play`` puts back what a test changes."""
    options = [f"engine={request.param}", "randomization=none", "engine.threads=1"]
    return Worlds(load_train_config(options), WORLDS, "cpu")


def standing(worlds: Worlds) -> Tensor:
    qpos = torch.as_tensor(worlds.model.key_qpos[0], dtype=torch.float32).repeat(WORLDS, 1)
    qpos[:, 0] = -2.0
    return qpos


def serve(worlds: Worlds, position: Tensor, velocity: Tensor) -> None:
    spin = torch.tensor([50.0, -100.0, 20.0])
    worlds.serve(EVERY, *(value.expand(WORLDS, 3) for value in (position, velocity, spin)))


def play(worlds: Worlds, change: Callable[[], None]) -> tuple[Tensor, Tensor]:
    """Ball (N, 18) after a bounce and after a strike, and the robot's velocities (N, 27) at the end.

    Every world stands, is changed by ``change``, and gets the same targets and balls.
    """
    worlds.reset_robot(EVERY, standing(worlds), torch.zeros(WORLDS, 27))
    change()
    targets = worlds.nominal.repeat(WORLDS, 1)
    targets[:, 4:8] += torch.tensor([-0.3, 0.2, 0.4, -0.2])  # the arm with the paddle
    serve(worlds, torch.tensor([-0.6, 0.0, 0.815]), torch.tensor([-6.0, 0.5, -2.0]))
    worlds.step(targets)
    worlds.step(targets)
    assert (worlds.ball.position[:, 2] > 0.79).all()  # it has bounced
    seen = [worlds.ball.position.clone(), worlds.ball.velocity.clone(), worlds.ball.spin.clone()]
    normal = worlds.robot.paddle_normal[0].clone()
    across = torch.linalg.cross(normal, torch.tensor([0.0, 0.0, 1.0]))
    # so slanting that friction slides: it then counts; 14 ms to the blade's middle
    serve(worlds, worlds.robot.paddle_position[0] + 0.1 * normal - 0.13 * across, 9.0 * across - 5.0 * normal)
    worlds.step(targets)
    assert (worlds.ball.events.paddle_hit == 1).all()
    worlds.step(targets)
    seen += [worlds.ball.position, worlds.ball.velocity, worlds.ball.spin]
    return torch.cat(seen, 1), worlds.engine.qvel_path[:, -1].clone()


def assert_only_world_1_changed(before: Tensor, after: Tensor, least: float) -> None:
    others = [0, 2]
    torch.testing.assert_close(after[others], before[others], rtol=0, atol=0)
    assert (after[1] - before[1]).abs().max() > least


@pytest.mark.parametrize("name", SAMPLED_BALL_PARAMS)
def test_a_ball_parameter_changes_its_world_alone(worlds: Worlds, name: str) -> None:
    grip = 50.0 if "tangential" in name else 0.2  # a contact either grips, and springs back, or slides

    def arrange() -> None:
        for friction in (worlds.ball.params.table_friction, worlds.ball.params.paddle_friction):
            torch.as_tensor(friction).fill_(grip)

    def change() -> None:
        arrange()
        value = getattr(worlds.ball.params, name)
        value[1] = 0.8 * value[1] if value[1] > 0 else 0.5

    ball, robot = play(worlds, arrange)
    changed_ball, changed_robot = play(worlds, change)
    assert_only_world_1_changed(ball, changed_ball, 1e-3)
    # what the paddle feels of it: another mass, speed or impulse of the ball; air and table act on it before
    felt = name.startswith(("mass", "paddle")) and name != "paddle_drilling_loss"  # which leaves no impulse
    least = 1e-4 if felt else -1.0
    assert_only_world_1_changed(robot, changed_robot, least)


def test_the_actuator_delay_changes_its_world_alone(worlds: Worlds) -> None:
    def change() -> None:
        worlds.randomizer.actuator_delay[1] = 0.006
        worlds.actuation.sample()

    _, robot = play(worlds, lambda: None)
    _, changed = play(worlds, change)
    assert_only_world_1_changed(robot, changed, 0.1)


@pytest.mark.parametrize("engine", ["native", "mjwarp"])
def test_a_reset_resamples_its_world_alone(engine: str) -> None:
    config = load_train_config([f"engine={engine}", "randomization=moderate", "engine.threads=1"])
    config.randomization.push_interval = [0.0, 0.0]
    worlds = Worlds(config, WORLDS, "cpu")
    worlds.reset_robot(EVERY, standing(worlds), torch.zeros(WORLDS, 27))
    start = {name: value.clone() for name, value in worlds.state_dict().items()}
    seen = []
    for mask in (torch.zeros(WORLDS, dtype=torch.bool), torch.tensor([False, True, False])):
        worlds.load_state_dict(start)
        worlds.reset_robot(mask, standing(worlds), torch.zeros(WORLDS, 27))
        serve(worlds, torch.tensor([-0.6, 0.0, 0.815]), torch.tensor([-6.0, 0.5, -2.0]))
        for _ in range(3):
            worlds.step(worlds.nominal.repeat(WORLDS, 1) + 0.2)
        seen.append((worlds.engine.qvel_path[:, -1].clone(), worlds.ball.velocity.clone()))
    (robot, ball), (new_robot, new_ball) = seen
    assert_only_world_1_changed(robot, new_robot, 1e-2)
    assert_only_world_1_changed(ball, new_ball, 1e-3)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("randomization.trunk_mass=[-20,2]", r"randomization.trunk_mass: with -20 kg nothing is left of the trunk's"),
        ("randomization.paddle_restitution=[-1,-0.9]", r"paddle_restitution with this ball gives \[-0.122, -0.022\]"),
        ("randomization.table_friction=[-9,-8]", r"table_friction with this ball gives \[-8.75, -7.75\]"),
    ],
)
def test_a_body_that_cannot_be_is_refused(override: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Worlds(load_train_config([override]), 1, "cpu")


@pytest.mark.parametrize(("share", "least", "most"), [(0.0, 0.0, 0.0), (0.5, 0.4, 0.6), (1.0, 1.0, 1.0)])
def test_a_share_of_the_worlds_has_the_presets_ball(share: float, least: float, most: float) -> None:
    config = load_train_config(["randomization=wide", f"randomization.preset_share={share}", "engine.threads=1"])
    worlds = Worlds(config, 400, "cpu")
    kept = torch.stack(
        [
            getattr(worlds.ball.params, name) == torch.tensor(float(getattr(config.ball, name)))
            for name in SAMPLED_BALL_PARAMS
            if len(set(drawn_range(name))) == 2  # the others have one value anyway
        ]
    )
    whole = kept.all(0)
    assert least <= float(whole.float().mean()) <= most
    assert not kept[:, ~whole].any()  # a world has all of the preset, or none
