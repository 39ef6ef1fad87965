"""The motors' torque-speed limit: a policy's use of its motors without it and with it, and the cost of a step."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch

from pace.config.base import ConfigError
from pace.config.sim import RobotConfig
from pace.config.training import load_train_config
from pace.evaluation.records import summarise
from pace.evaluation.serves import ServeRecorder, play
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.metrics import markdown
from pace.sim.engine.native import stop_timers
from pace.sim.robot import motor_lines
from pace.sim.robot_spec import RobotSpec
from pace.studies.common import ENDLESS, Array, model_of, study_config, study_spec
from pace.task.env import TableTennisEnv

ROBOT = "robot=t1"  # the limit is that of configs/, not that of an older policy
WITHOUT, WITH = "without", "with"
CASES = {WITHOUT: [ROBOT, "robot.stall_ratio=0"], WITH: [ROBOT]}
#: Groups of motors, the first match counts.
GROUPS = ("Right_Shoulder", "Right_Elbow", "Left_Shoulder", "Left_Elbow", "Waist", "Hip", "Knee", "Ankle")
SLACK = 1e-3  # of the stall torque: float32
SEED = 3
COST_STEPS = 10


class MotorRecorder(ServeRecorder):
    """Outcomes of the serves, and use of the motors: counts of instants, by joint.

    Attributes: ``instants``; ``fast`` (J,): speed over the motor's greatest; ``over`` (J,): torque over the line of
    its world (in the last physics step of a control step, like ``joint_torque``); ``held`` (J,): torque at or over the
    limit of line and effort; ``fastest`` (J,): largest speed, of the motor's greatest; ``excess`` (J,): largest
    torque over the line, of the effort.
    """

    def __init__(self, env: TableTennisEnv, warmup_serves: int, quota: int, robot: RobotConfig) -> None:
        super().__init__(env, warmup_serves, quota)
        lines = motor_lines(robot)
        if lines is None:
            raise ConfigError("configs/robot/t1.yaml has no stall_ratio: there is no line to compare with")
        self._speed, self._stall = torch.as_tensor(lines, dtype=torch.float32)
        self._effort = self._stall / robot.stall_ratio
        self.instants = 0
        counts = (torch.zeros(len(RobotSpec.of(robot).joints)) for _ in range(5))
        self.fast, self.over, self.held, self.fastest, self.excess = counts

    def observe(self) -> None:
        super().observe()
        engine = self.env.worlds.engine
        share = engine.qvel_path[:, -2, 6:] / self._speed
        torque = engine.joint_torque * share.sign()
        scale = engine.params.effort_scale.unsqueeze(-1)
        stall, effort = scale * self._stall, scale * self._effort
        beyond = torque - stall * (1.0 - share.abs())
        self.instants += self.env.num_worlds
        self.fast += (share.abs() > 1.0).sum(0)
        self.over += (beyond > SLACK * stall).sum(0)
        self.held += ((beyond > -SLACK * stall) | (torque.abs() > (1.0 - SLACK) * effort)).sum(0)
        torch.maximum(self.fastest, share.abs().amax(0), out=self.fastest)
        torch.maximum(self.excess, (beyond / effort).amax(0), out=self.excess)


@dataclass(frozen=True)
class Use:
    """Serves of a policy and use of its motors; arrays (J,): three shares of time, then of greatest speed, effort."""

    policy: str
    joints: tuple[str, ...]
    case: str
    hit: float
    success: float
    serves: int
    fast: Array
    over: Array
    held: Array
    fastest: Array
    excess: Array


def use(policy: TaskPolicy, case: str, worlds: int, serves: int) -> Use:
    """Play ``serves`` mixed serves of the saved task, counted after each world's first, 2 ms a physics step."""
    env = policy.make_env(worlds, "cpu", SEED, [*ENDLESS, *CASES[case]])
    recorder = MotorRecorder(env, 1, math.ceil(serves / worlds), load_train_config().robot)
    play(env, policy, recorder)
    table = env.config.ball.table
    clear = table.height + table.net_height + env.config.ball.radius
    row = summarise("mixed", recorder.records[:-1], (0.0, 0.0), clear)
    shares = (count / recorder.instants for count in (recorder.fast, recorder.over, recorder.held))
    arrays = [array.double().numpy() for array in (*shares, recorder.fastest, recorder.excess)]
    return Use(policy.source, env.worlds.spec.joints, case, row["hit"], row["success"], row["serves"], *arrays)


def uses(runs: Sequence[Path], worlds: int, serves: int) -> list[Use]:
    """Every policy without the limit and with it."""
    found = []
    for run in runs:
        policy = load_policy(run)
        for case in CASES:
            found.append(use(policy, case, worlds, serves))
            print(f"{Path(found[-1].policy).name}, {case}: done", flush=True)
    return found


def table(found: Sequence[Use]) -> str:
    """One column per evaluation: its serves, then for each group of motors the time (%) beyond its speed, beyond its
    line and at its limit, the largest speed, and the largest torque over the line."""
    header = ["", *(f"{Path(use.policy).name}, {use.case}" for use in found)]
    rows = [[f"hit, success (%) of {found[0].serves} serves"]]
    rows[0] += [f"{100 * use.hit:.1f}, {100 * use.success:.1f}" for use in found]
    for group in GROUPS:
        columns = [i for i, name in enumerate(found[0].joints) if group in name]
        cells = [
            ", ".join(f"{100 * share[columns].mean():.2f}" for share in (use.fast, use.over, use.held))
            + f", {use.fastest[columns].max():.2f}, {use.excess[columns].max():.2f}"
            for use in found
        ]
        rows.append([group.replace("_", " ").lower(), *cells])
    return markdown(header, rows)


def cost(worlds: int = 256, repeats: int = 7) -> dict[str, float]:
    """Processor time (s) of a physics step of one world, native, one thread: the least of ``repeats`` alternations.

    Standing robots whose targets jump, so that some motors saturate.
    """
    stop_timers()
    batches = {}
    for case, ratio in ((WITHOUT, 0.0), (WITH, 2.0)):
        config = study_config(physics_dt=0.002)
        model = model_of(dataclasses.replace(config, robot=dataclasses.replace(config.robot, stall_ratio=ratio)))
        batches[case] = (model, Batch(model, worlds, 1))
    targets = np.random.default_rng(SEED).normal(0.0, 0.3, (worlds, 1, len(study_spec().joints)))
    least = dict.fromkeys(batches, math.inf)
    for _ in range(repeats):
        for case, (model, batch) in batches.items():
            control = np.repeat(model.key_qpos[0, 7:] + targets, COST_STEPS, axis=1)
            batch.bind("qpos")[:], batch.bind("qvel")[:] = model.key_qpos[0], 0.0
            batch.bind("qacc_warmstart")[:] = 0.0
            started = time.process_time()
            batch.rollout(COST_STEPS, control, int(mujoco.mjtState.mjSTATE_CTRL), ("qpos",))
            least[case] = min(least[case], time.process_time() - started)
    return {case: spent / (worlds * COST_STEPS) for case, spent in least.items()}
