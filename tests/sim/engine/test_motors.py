"""The motors' torque in closed form, in both engines: a PD law, a line over speed, and a cap."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch

from pace.config.base import ConfigError, parse, to_dict
from pace.config.training import load_train_config
from pace.sim.engine.factory import make_engine
from pace.sim.robot import build_model, joint_gains, motor_lines
from pace.sim.robot_spec import RobotSpec

CONFIGS = {name: load_train_config([f"robot={name}"]) for name in ("t1", "t1_paper", "t1_29dof")}
CONFIG = CONFIGS["t1"]
WORLDS = 8
EVERY = torch.ones(WORLDS, dtype=torch.bool)
Factor = float | np.ndarray  # of all worlds, or (N, 1)
#: Engine and robot; only make test-long builds another robot on mjwarp.
PAIRS = [
    ("native", "t1"),
    ("mjwarp", "t1"),
    ("native", "t1_paper"),
    ("native", "t1_29dof"),
    pytest.param(("mjwarp", "t1_29dof"), marks=pytest.mark.long),
]


@dataclasses.dataclass(frozen=True)
class Motors:
    """The numbers of a robot's motors (J,), from its configuration."""

    joints: tuple[str, ...]
    kp: np.ndarray
    kd: np.ndarray
    effort: np.ndarray
    speed: np.ndarray
    stall: np.ndarray

    @classmethod
    def of(cls, robot):
        lines = motor_lines(robot)
        assert lines is not None
        return cls(RobotSpec.of(robot).joints, *joint_gains(robot), *lines)

    def at(self, share):
        """Speeds (N, J) at this share of the no-load speed."""
        return share * torch.as_tensor(self.speed, dtype=torch.float32).expand(WORLDS, len(self.joints))

    def law(self, offset, speed, kp: Factor = 1.0, kd: Factor = 1.0, effort: Factor = 1.0, no_load: Factor = 1.0):
        """PD, within the lines of both directions of voltage, within the effort."""
        wanted = kp * self.kp * offset.double().numpy() - kd * self.kd * speed.double().numpy()
        back = effort * self.stall / (no_load * self.speed) * speed.double().numpy()
        wanted = np.clip(wanted, -effort * self.stall - back, effort * self.stall - back)
        return np.clip(wanted, -effort * self.effort, effort * self.effort)


def make(name, physics_dt=0.002, stall_ratio=2.0, robot="t1"):
    """An engine of one physics step a control step, and its model."""
    config = CONFIGS[robot]
    engine = dataclasses.replace(config.engine, name=name, physics_dt=physics_dt, threads=1)
    model = build_model(dataclasses.replace(config.robot, stall_ratio=stall_ratio), engine, config.ball.table)
    return make_engine(model, engine, WORLDS, "cpu", 1), model


@pytest.fixture(scope="module", params=PAIRS, ids="-".join)
def pair(request):
    return request.param


@pytest.fixture(scope="module")
def built(pair):
    name, robot = pair
    return make(name, robot=robot)


@pytest.fixture(scope="module")
def motors(pair):
    return Motors.of(CONFIGS[pair[1]].robot)


def torques(built, offset, speed):
    """What the motors give at ``speed`` (N, J) rad/s, ``offset`` (N, J) rad before their targets."""
    engine, model = built
    qpos = torch.as_tensor(model.key_qpos, dtype=torch.float32).repeat(WORLDS, 1)
    qpos[:, 2] += 1.0
    qvel = torch.zeros(WORLDS, model.nv)
    qvel[:, 6:] = speed
    engine.reset(EVERY, qpos, qvel)
    engine.advance((qpos[:, 7:] + offset).unsqueeze(1), torch.zeros(WORLDS, model.nv))
    return engine.joint_torque.double().numpy()


def test_below_the_line_the_torque_is_pd(built, motors):
    generator = torch.Generator().manual_seed(1)
    offset, speed = (0.2 * torch.randn(WORLDS, len(motors.joints), generator=generator) for _ in range(2))
    expected = motors.kp * offset.double().numpy() - motors.kd * speed.double().numpy()
    np.testing.assert_allclose(motors.law(offset, speed), np.clip(expected, -motors.effort, motors.effort))
    assert (np.abs(expected) < motors.effort).mean() > 0.8
    # the float32 of mjwarp: one part in 10^7 of the joint's angle and of the stall torque
    np.testing.assert_allclose(torques(built, offset, speed), motors.law(offset, speed), rtol=1e-5, atol=3e-5)


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize(("share", "of_effort"), [(0.0, 1.0), (0.5, 1.0), (0.75, 0.5), (1.0, 0.0), (1.2, -0.4)])
def test_drive_falls_with_speed_from_full_effort_at_half_to_zero(built, motors, direction, share, of_effort):
    speed = motors.at(direction * share)
    given = torques(built, torch.full_like(speed, 50.0 * direction), speed)
    np.testing.assert_allclose(given, np.tile(direction * of_effort * motors.effort, (WORLDS, 1)), atol=1e-4)


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0, 1.2])
def test_brakes_give_full_effort_at_any_speed(built, motors, share):
    speed = motors.at(share)
    np.testing.assert_allclose(
        torques(built, torch.full_like(speed, -50.0), speed), -np.tile(motors.effort, (WORLDS, 1))
    )
    damped = torques(built, torch.zeros_like(speed), speed)  # nothing but kd, up to the effort
    np.testing.assert_allclose(damped, motors.law(torch.zeros_like(speed), speed), atol=1e-4)
    np.testing.assert_allclose(damped, np.maximum(-motors.kd * speed.numpy(), -motors.effort), atol=1e-4)


def test_each_world_has_its_own_gains_stall_torque_and_no_load_speed(built, motors):
    engine, _ = built
    scales = {
        "kp": torch.linspace(0.8, 1.2, WORLDS),
        "kd": torch.linspace(1.3, 0.7, WORLDS),
        "effort": torch.linspace(0.5, 1.0, WORLDS),
        "speed": torch.linspace(1.4, 0.9, WORLDS),
        "ankle_effort": torch.linspace(1.0, 0.6, WORLDS),
    }
    for name, values in scales.items():
        getattr(engine.params, f"{name}_scale").copy_(values)
    engine.apply_params(EVERY)
    columns = {name: values.double().view(-1, 1).numpy() for name, values in scales.items()}
    columns["no_load"] = columns.pop("speed")
    at_ankle = np.array(["Ankle" in name for name in motors.joints])
    columns["effort"] = columns["effort"] * np.where(at_ankle, columns.pop("ankle_effort"), 1.0)
    generator = torch.Generator().manual_seed(2)
    regimes = {"pd": (0.05, 0.0), "line": (5.0, 0.8), "brake": (-5.0, 0.8)}
    for reach, share in regimes.values():
        speed = motors.at(share)
        offset = reach * (1.0 + 0.1 * torch.rand(speed.shape, generator=generator))
        np.testing.assert_allclose(torques(built, offset, speed), motors.law(offset, speed, **columns), atol=2e-4)
    for name in scales:
        getattr(engine.params, f"{name}_scale").fill_(1.0)
    engine.apply_params(EVERY)


@pytest.mark.parametrize("physics_dt", [0.002, 0.01])
@pytest.mark.parametrize("name", ["native", "mjwarp"])
def test_no_drive_beyond_the_greatest_speed(name, physics_dt):
    """A far target spins the forearm up to its motor's no-load speed, and past it where the motor knows no speed."""
    motors, fastest = Motors.of(CONFIG.robot), {}
    joint = motors.joints.index("Right_Elbow_Yaw")  # light enough to reach its greatest speed within its range
    for ratio in (2.0, 0.0):
        engine, model = make(name, physics_dt, ratio)
        qpos = torch.as_tensor(model.key_qpos, dtype=torch.float32).repeat(WORLDS, 1)
        qpos[:, 2] += 1.0
        qpos[:, 7 + joint] = 0.2
        engine.reset(EVERY, qpos, torch.zeros(WORLDS, model.nv))
        targets = qpos[:, 7:].clone()
        targets[:, joint] = 50.0
        speeds = []
        while engine.qpos_path[0, -1, 7 + joint] < 2.0 and len(speeds) < 1.0 / physics_dt:
            engine.advance(targets.unsqueeze(1), torch.zeros(WORLDS, model.nv))
            speeds.append(float(engine.qvel_path[0, -1, 6 + joint]))
        fastest[ratio] = max(speeds) / motors.speed[joint]
    assert 0.9 < fastest[2.0] <= 1.001
    assert fastest[0.0] > 1.2


def test_motors_have_no_state_and_their_order(built, motors):
    _, model = built
    assert (model.na, model.nu) == (0, len(motors.joints))
    assert (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_DCMOTOR).all()
    assert (model.actuator_trnid[:, 0] == np.arange(1, 1 + model.nu)).all()


def test_without_the_keys_the_motors_are_those_of_before():
    """As a configuration that was stored before they existed."""
    robot = to_dict(CONFIG.robot)
    del robot["stall_ratio"]
    for group in robot["joint_groups"]:
        del group["max_speed"]
    stored = parse(robot, type(CONFIG.robot))
    assert motor_lines(stored) is None
    model = build_model(stored, CONFIG.engine, CONFIG.ball.table)
    assert (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED).all()
    with pytest.raises(ConfigError, match=r"max_speed.*Hip_Pitch"):
        dataclasses.replace(stored, stall_ratio=2.0)
    first = dataclasses.replace(CONFIG.robot.joint_groups[0], max_speed=5e-324)
    with pytest.raises(ConfigError, match=r"max_speed.*Hip_Pitch"):  # with it the motor's resistance is 0
        dataclasses.replace(CONFIG.robot, joint_groups=[first, *CONFIG.robot.joint_groups[1:]])
    for wrong in (0.5, math.inf, math.nan):
        with pytest.raises(ConfigError, match="stall_ratio"):
            dataclasses.replace(CONFIG.robot, stall_ratio=wrong)
