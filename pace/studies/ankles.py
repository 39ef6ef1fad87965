"""Ankles as their motors drive them: two motors turn both joints of an ankle, and share their limits and inertia.

With pitch p and roll r of an ankle, its motors A and B turn by p + a r and p - b r. The levers a and b say how far roll
turns them (1: as far as pitch). The joints' torques are then A + B and a A - b B. The maker publishes no linkage:
the motors' effort and the lever of both are those with which either joint alone reaches its own limit (:func:`motor`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from pace.config.base import ConfigError
from pace.config.overrides import override_task, without_reward
from pace.config.sim import EngineConfig, RobotConfig
from pace.config.training import load_train_config
from pace.evaluation.serves import ServeRecorder, play, summarise
from pace.rl.policies import TaskPolicy
from pace.runs.metrics import markdown
from pace.sim.engine.factory import ENGINES
from pace.sim.engine.native import CONTROL, NativeEngine
from pace.sim.robot import compile_scene, describe_scene, joint_armature, joint_gains, motor_lines
from pace.sim.robot_spec import RobotSpec
from pace.sim.worlds import Worlds
from pace.studies.common import ENDLESS, Array
from pace.task.env import TableTennisEnv

SIDES = ("Left", "Right")
ROBOT = "robot=t1"
TASK = ("sensing=paper", "randomization=moderate", ROBOT)
ENGINE = "ankle_motors"
SEED = 5


@dataclass(frozen=True)
class Motor:
    """Each motor of an ankle: effort and stall torque (N m), no-load speed (rad/s), armature (kg m^2), lever."""

    effort: float
    stall: float
    speed: float
    armature: float
    lever: float


@lru_cache
def motor() -> Motor:
    """Two of these have the limits of ``robot=t1`` in pitch alone and in roll alone, and its armature in pitch."""
    robot = load_train_config([ROBOT]).robot
    lines, pitch_and_roll = motor_lines(robot), ankle_columns(robot)[0]
    if lines is None:
        raise ConfigError(f"configs/robot/{robot.name}.yaml has no stall_ratio: its motors have no line")
    pitch, roll = joint_gains(robot)[2, pitch_and_roll] / 2
    speed, armature = lines[0, pitch_and_roll[0]], joint_armature(robot)[pitch_and_roll[0]] / 2
    return Motor(float(pitch), robot.stall_ratio * float(pitch), float(speed), float(armature), float(roll / pitch))


def ankle_columns(robot: RobotConfig) -> NDArray[np.int64]:
    """Places (2, 2) of pitch and roll among the joints, a row for each side."""
    joints = RobotSpec.of(robot).joints
    return np.array([[joints.index(f"{side}_Ankle_{axis}") for axis in ("Pitch", "Roll")] for side in SIDES])


@dataclass(frozen=True)
class Ankles:
    """What a case changes of ``robot=t1``.

    Attributes: ``limited``: the motors' limits hold, besides those of the joints; ``levers``: those of motors A and B
    in the inertia, times the lever of :func:`motor`; None: inertia of pitch and roll as configured.
    """

    limited: bool = False
    levers: tuple[float, float] | None = None


UNEVEN = (1.2, 0.8)  # rods of different lengths: the inertia couples pitch and roll
CASES = {
    "as configured": Ankles(),
    "limits of the motors": Ankles(limited=True),
    "inertia of the motors": Ankles(levers=(1.0, 1.0)),
    "inertia, levers 1.2 and 0.8": Ankles(levers=UNEVEN),
    "limits, and inertia with levers 1.2 and 0.8": Ankles(limited=True, levers=UNEVEN),
}


def motor_torques(pitch: Array, roll: Array) -> tuple[Array, Array]:
    """Torques of motors A and B (N m) for the torques of the joints."""
    return (pitch + roll / motor().lever) / 2, (pitch - roll / motor().lever) / 2


def motor_speeds(pitch: Array, roll: Array) -> tuple[Array, Array]:
    """Speeds of motors A and B (rad/s) at the speeds of the joints."""
    return pitch + motor().lever * roll, pitch - motor().lever * roll


def within_limits(torques: tuple[Array, Array], speeds: tuple[Array, Array], scale: Array) -> tuple[Array, Array]:
    """What remains of the torques of pitch and roll (N m) when each motor gives what it can.

    ``speeds`` of the joints, rad/s; ``scale`` of the motors' effort and stall torque.
    """
    one, given = motor(), []
    for torque, speed in zip(motor_torques(*torques), motor_speeds(*speeds), strict=True):
        most, back = one.stall * scale, one.stall * scale * speed / one.speed
        given.append(np.clip(np.clip(torque, -most - back, most - back), -one.effort * scale, one.effort * scale))
    return given[0] + given[1], one.lever * (given[0] - given[1])


class AnkleMotors(NativeEngine):
    """The native engine, whose ankle targets are moved in each physics step so that the motors' limits hold."""

    def __init__(
        self, model: mujoco.MjModel, engine: EngineConfig, num_worlds: int, device: torch.device, substeps: int
    ) -> None:
        super().__init__(model, engine, num_worlds, device, substeps)
        self._columns = ankle_columns(load_train_config([ROBOT]).robot)
        self._gains = model.actuator_gainprm[:, [4, 6]].T.copy()  # kp, kd of a motor with a line
        self._once = {name: np.zeros_like(values[:, :1]) for name, values in self._record.items()}

    def _roll_out(self) -> None:
        for step in range(self.substeps):
            self._limit(self._targets[:, step])
            self._batch.rollout(1, self._control[:, step : step + 1].copy(), CONTROL, tuple(self._once), out=self._once)
            for name, values in self._once.items():
                self._record[name][:, step : step + 1] = values

    def _limit(self, targets: Array) -> None:
        """Replace the ankles' ``targets`` (N, J) rad by those that ask for the torque that the motors can give."""
        params = self.params
        scales = (params.kp_scale, params.kd_scale, params.effort_scale * params.ankle_effort_scale)
        kp_scale, kd_scale, effort_scale = (scale.double().numpy() for scale in scales)
        for columns in self._columns:
            position, speed = self._qpos[:, 7 + columns], self._qvel[:, 6 + columns]
            kp, kd = kp_scale[:, None] * self._gains[0, columns], kd_scale[:, None] * self._gains[1, columns]
            wanted = kp * (targets[:, columns] - position) - kd * speed
            given = within_limits((wanted[:, 0], wanted[:, 1]), (speed[:, 0], speed[:, 1]), effort_scale)
            targets[:, columns] = position + (np.stack(given, 1) + kd * speed) / kp


def couple(spec: mujoco.MjSpec, levers: tuple[float, float]) -> None:
    """Give the ankles the inertia of their motors, as that of a tendon round both joints for each motor.

    ``levers``: times that of :func:`motor`.
    """
    for side in SIDES:
        pitch, roll = (spec.joint(f"{side}_Ankle_{axis}") for axis in ("Pitch", "Roll"))
        pitch.armature = roll.armature = 0.0
        for name, lever in zip("AB", (levers[0], -levers[1]), strict=True):
            tendon = spec.add_tendon(name=f"{side}_ankle_motor_{name}", armature=motor().armature)
            tendon.wrap_joint(pitch.name, 1.0)
            tendon.wrap_joint(roll.name, lever * motor().lever)


def make_env(policy: TaskPolicy, ankles: Ankles, worlds: int) -> TableTennisEnv:
    """The policy's task on ``robot=t1`` with ``ankles``: native, 2 ms a physics step, mixed serves without end."""
    ENGINES[ENGINE] = AnkleMotors
    engine = [f"engine={ENGINE}"] if ankles.limited else []
    config = without_reward(override_task(policy.config, [*ENDLESS, *TASK, *engine]))
    spec = describe_scene(config.robot, config.engine, config.ball.table)
    if ankles.levers:
        couple(spec, ankles.levers)
    simulation = Worlds(config, worlds, "cpu", model=compile_scene(spec, config.robot))
    return TableTennisEnv(config, worlds, "cpu", SEED, policy.to("cpu").predictor, simulation)


class AnkleRecorder(ServeRecorder):
    """Outcomes of the serves, and shares of time.

    Attributes: ``instants``; ``torque``: ankles whose torque is beyond the motors' effort; ``speed``: ankles that turn
    a motor faster than its no-load speed. Both in the last physics step of a control step.
    """

    def __init__(self, env: TableTennisEnv, warmup_serves: int, quota: int) -> None:
        super().__init__(env, warmup_serves, quota)
        self._columns = ankle_columns(env.config.robot)
        self.instants = self.torque = self.speed = 0

    def observe(self) -> None:
        super().observe()
        engine = self.env.worlds.engine
        effort = 1.001 * motor().effort * (engine.params.effort_scale * engine.params.ankle_effort_scale).numpy()
        for columns in self._columns:
            torques = motor_torques(*engine.joint_torque[:, columns].numpy().T)
            speeds = motor_speeds(*engine.qvel_path[:, -2, 6 + columns].numpy().T)
            self.instants += len(effort)
            self.torque += int((np.abs(torques).max(0) > effort).sum())
            self.speed += int((np.abs(speeds).max(0) > motor().speed).sum())


@dataclass(frozen=True)
class Found:
    """A case: its row of :func:`pace.evaluation.serves.summarise`, and two shares of time (:class:`AnkleRecorder`)."""

    case: str
    row: dict[str, Any]
    torque: float
    speed: float


def compare(policy: TaskPolicy, worlds: int, serves: int) -> list[Found]:
    """Every case of CASES, ``serves`` mixed serves each, counted after each world's first two."""
    found = []
    for case, ankles in CASES.items():
        env = make_env(policy, ankles, worlds)
        recorder = AnkleRecorder(env, 2, math.ceil(serves / worlds))
        play(env, policy, recorder)
        row = summarise("mixed", recorder.records[:-1], (0.0, 0.0), 0.0)
        found.append(Found(case, row, recorder.torque / recorder.instants, recorder.speed / recorder.instants))
        print(f"{case}: done", flush=True)
    return found


def table(found: list[Found]) -> str:
    """A row per case: serves (% with 95 % intervals), falls, and shares of time (%)."""
    serves = found[0].row["serves"]
    header = [
        f"ankles, {serves} serves each",
        "hit, %",
        "success, %",
        "falls in 1,000",
        "beyond effort, %",
        "beyond speed, %",
    ]
    rows = []
    for one in found:
        shares = (
            f"{100 * one.row[name]:.1f} ({100 * one.row[f'{name}_low']:.1f} to {100 * one.row[f'{name}_high']:.1f})"
            for name in ("hit", "success")
        )
        falls = f"{one.row['falls_per_1000']:.1f}"
        rows.append([one.case, *shares, falls, f"{100 * one.torque:.2f}", f"{100 * one.speed:.2f}"])
    return markdown(header, rows)
