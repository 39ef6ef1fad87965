"""Use of the motors by a policy, on each robot and without the torque-speed limit; the cost of that limit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from pace.config.base import ConfigError
from pace.config.sim import RobotConfig
from pace.config.training import load_train_config
from pace.evaluation.records import summarise
from pace.evaluation.serves import ServeRecorder, play
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.metrics import markdown
from pace.sim.robot import motor_lines
from pace.sim.robot_spec import RobotSpec
from pace.studies.common import ENDLESS, Array, model_of, native_cost, study_config
from pace.task.env import TableTennisEnv

WITHOUT, WITH, PAPER = "t1 without the line", "t1", "t1_paper"
#: Case: robot of configs/, whose line is also that of a policy that was saved without one, and changes of it.
CASES = {PAPER: ("t1_paper", []), WITHOUT: ("t1", ["robot.stall_ratio=0"]), WITH: ("t1", [])}
#: Groups of motors, the first match counts.
GROUPS = ("Right_Shoulder", "Right_Elbow", "Left_Shoulder", "Left_Elbow", "Waist", "Hip", "Knee", "Ankle")
SLACK = 1e-3  # of the stall torque: float32
END = 0.02  # of a joint's range, from either end
SEED = 3


class MotorRecorder(ServeRecorder):
    """Outcomes of the serves, and use of the motors: counts of instants, by joint.

    Attributes: ``instants``; ``fast`` (J,): speed over the motor's greatest; ``over`` (J,): torque over the line of
    its world (in the last physics step of a control step, like ``joint_torque``); ``held`` (J,): torque at or over the
    limit of line and effort; ``ended`` (J,): within END of the joint's range from its ends; ``fastest`` (J,): largest
    speed, of the motor's greatest; ``excess`` (J,): largest torque over the line, of the effort.
    """

    def __init__(self, env: TableTennisEnv, warmup_serves: int, quota: int, robot: RobotConfig) -> None:
        super().__init__(env, warmup_serves, quota)
        lines, spec = motor_lines(robot), RobotSpec.of(robot)
        if lines is None:
            raise ConfigError(f"configs/robot/{robot.name}.yaml has no stall_ratio: there is no line to compare with")
        self._speed, self._stall = torch.as_tensor(lines, dtype=torch.float32)
        self._effort = self._stall / robot.stall_ratio
        self._at_ankle = torch.tensor([name in spec.groups.get("ankles", ()) for name in spec.joints]).float()
        self.instants = 0
        counts = (torch.zeros(len(spec.joints)) for _ in range(6))
        self.fast, self.over, self.held, self.ended, self.fastest, self.excess = counts
        margin = END * (env.worlds.joint_upper - env.worlds.joint_lower)
        self._inner = env.worlds.joint_lower + margin, env.worlds.joint_upper - margin

    def observe(self) -> None:
        super().observe()
        engine = self.env.worlds.engine
        params = engine.params
        share = engine.qvel_path[:, -2, 6:] / (params.speed_scale.unsqueeze(-1) * self._speed)
        torque = engine.joint_torque * share.sign()
        scale = params.effort_scale.unsqueeze(-1) * params.ankle_effort_scale.unsqueeze(-1) ** self._at_ankle
        stall, effort = scale * self._stall, scale * self._effort
        beyond = torque - stall * (1.0 - share.abs())
        self.instants += self.env.num_worlds
        self.fast += (share.abs() > 1.0).sum(0)
        self.over += (beyond > SLACK * stall).sum(0)
        self.held += ((beyond > -SLACK * stall) | (torque.abs() > (1.0 - SLACK) * effort)).sum(0)
        position = self.env.worlds.robot.joint_position
        self.ended += ((position < self._inner[0]) | (position > self._inner[1])).sum(0)
        torch.maximum(self.fastest, share.abs().amax(0), out=self.fastest)
        torch.maximum(self.excess, (beyond / effort).amax(0), out=self.excess)


@dataclass(frozen=True)
class Use:
    """Serves of a policy and use of its motors; arrays (J,): four shares of time, then of greatest speed, effort."""

    policy: str
    joints: tuple[str, ...]
    case: str
    hit: float
    success: float
    serves: int
    fast: Array
    over: Array
    held: Array
    ended: Array
    fastest: Array
    excess: Array


def use(policy: TaskPolicy, case: str, worlds: int, serves: int) -> Use:
    """Play ``serves`` mixed serves of the saved task, counted after each world's first, 2 ms a physics step."""
    name, changes = CASES[case]
    robot = f"robot={name}"
    env = policy.make_env(worlds, "cpu", SEED, [*ENDLESS, robot, *changes])
    recorder = MotorRecorder(env, 1, math.ceil(serves / worlds), load_train_config([robot]).robot)
    play(env, policy, recorder)
    table = env.config.ball.table
    clear = table.height + table.net_height + env.config.ball.radius
    row = summarise("mixed", recorder.records[:-1], (0.0, 0.0), clear)
    counts = (recorder.fast, recorder.over, recorder.held, recorder.ended)
    shares = (count / recorder.instants for count in counts)
    arrays = [array.double().numpy() for array in (*shares, recorder.fastest, recorder.excess)]
    return Use(policy.source, env.worlds.spec.joints, case, row["hit"], row["success"], row["serves"], *arrays)


def uses(runs: Sequence[Path], worlds: int, serves: int) -> list[Use]:
    """Every policy in every case."""
    found = []
    for run in runs:
        policy = load_policy(run)
        for case in CASES:
            found.append(use(policy, case, worlds, serves))
            print(f"{Path(found[-1].policy).name}, {case}: done", flush=True)
    return found


def table(found: Sequence[Use]) -> str:
    """One column per evaluation: its serves, then for each group of motors the time (%) beyond its speed, beyond its
    line, at its limit and at a joint's end, the largest speed, and the largest torque over the line."""
    header = ["", *(f"{Path(use.policy).name}, {use.case}" for use in found)]
    rows = [[f"hit, success (%) of {found[0].serves} serves"]]
    rows[0] += [f"{100 * use.hit:.1f}, {100 * use.success:.1f}" for use in found]
    for group in GROUPS:
        columns = [i for i, name in enumerate(found[0].joints) if group in name]
        cells = [
            ", ".join(f"{100 * share[columns].mean():.2f}" for share in (use.fast, use.over, use.held, use.ended))
            + f", {use.fastest[columns].max():.2f}, {use.excess[columns].max():.2f}"
            for use in found
        ]
        rows.append([group.replace("_", " ").lower(), *cells])
    return markdown(header, rows)


def cost(worlds: int = 256, repeats: int = 7) -> dict[str, float]:
    """Processor time (s) of a physics step of one world without the limit and with it (:func:`native_cost`)."""
    config = study_config(physics_dt=0.002)
    models = {
        case: model_of(dataclasses.replace(config, robot=dataclasses.replace(config.robot, stall_ratio=ratio)))
        for case, ratio in (("without the limit", 0.0), ("with it", 2.0))
    }
    return native_cost(models, worlds, repeats)
