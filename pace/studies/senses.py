"""Errors of the on-board estimates of motion capture's delay and of the robot's pose, by the time since the reset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.onboard.estimates import observed
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.metrics import markdown
from pace.studies.common import ENDLESS
from pace.task.env import TableTennisEnv
from pace.task.observations import POLICY

TIMES = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # s since the episode began
SEED = 5
#: The paper's noise, and delays that differ by 26 ms.
TASK = ("sensing=paper", "sensing.mocap_delay=[0.004,0.030]", "randomization=moderate")
COLUMNS = (
    "delay, ms", "gravity sensed, mrad", "estimated", "heading sensed, mrad", "estimated", "joints sensed, mrad",
    "estimated", "joints sensed, rad/s", "estimated", "paddle sensed, mm", "estimated",
)  # fmt: skip
NEEDED = {"delay", "attitude", "joints"}  # of pace.onboard.estimates

ESTIMATED = (
    "sensed_delay", "estimated_gravity", "estimated_heading", "estimated_joint_position", "estimated_joint_velocity",
)  # fmt: skip


@dataclass(frozen=True)
class Senses:
    """Root mean square errors (times, columns) over worlds without a fall, in the units of ``COLUMNS``."""

    policy: str
    errors: Tensor


def sense(run: Path, worlds: int) -> Senses:
    """Roll out ``worlds`` robots for the longest of ``TIMES``. Errors: :class:`ConfigError` for a policy that does not
    estimate them."""
    policy = load_policy(run)
    if not observed(policy.config.observation).keys() >= NEEDED:
        raise ConfigError(f"{run} does not observe its delay, orientation and joints: give one of observation=memory")
    env = policy.make_env(worlds, "cpu", SEED, [*ENDLESS, *TASK])
    steps = [round(time / env.worlds.control_dt) for time in TIMES]
    return Senses(run.name, torch.stack(_play(env, policy, steps)))


def _play(env: TableTennisEnv, policy: TaskPolicy, steps: Sequence[int]) -> list[Tensor]:
    rows = []
    stood = torch.ones(env.num_worlds, dtype=torch.bool)
    for step in range(1, steps[-1] + 1):
        env.advance(policy(env.policy_observation))
        stood &= ~env.terminated  # a fall begins another episode
        if step in steps:
            rows.append(torch.stack([error[stood].square().sum(1).mean().sqrt() for error in errors(env)]))
    return rows


def errors(env: TableTennisEnv) -> list[Tensor]:
    """Each world's error (N, size) of every column, in its unit; their norms count."""
    sensing, actor, robot = env.sensing, env.actor, env.worlds.robot
    prior = env.config.observation.delay_estimate
    assert prior is not None  # guaranteed by sense()
    estimated = {name: POLICY[name].function(actor) for name in ESTIMATED}
    delay = estimated["sensed_delay"] + prior.prior - (sensing.delay * env.worlds.control_dt).unsqueeze(1)
    gravity = [given - robot.projected_gravity for given in (sensing.projected_gravity, estimated["estimated_gravity"])]
    heading = [_angle(given, robot.heading) for given in (sensing.heading, estimated["estimated_heading"])]
    joints = robot.joint_position - env.worlds.nominal
    bent = [given - joints for given in (sensing.joint_position, estimated["estimated_joint_position"])]
    velocities = (sensing.joint_velocity, estimated["estimated_joint_velocity"])
    moving = [given - robot.joint_velocity for given in velocities]
    each = sensing.joint_position.shape[1] ** -0.5  # of one joint
    paddle = [position - robot.paddle_position for position in (_sensed_paddle(env), actor.paddle_position)]
    in_milli = [[1e3 * error for error in pair] for pair in (gravity, heading, bent, paddle)]
    pairs = [in_milli[0], in_milli[1], [each * error for error in in_milli[2]], [each * error for error in moving]]
    return [1e3 * delay, *(error for pair in (*pairs, in_milli[3]) for error in pair)]


def _angle(given: Tensor, true: Tensor) -> Tensor:
    across = true[:, 0] * given[:, 1] - true[:, 1] * given[:, 0]
    return torch.atan2(across, (true * given).sum(1)).unsqueeze(1)


def _sensed_paddle(env: TableTennisEnv) -> Tensor:
    """(N, 3) m, by forward kinematics from the sensed signals alone."""
    sensing = env.sensing
    joints = sensing.joint_position + env.worlds.nominal
    return env.actor.onboard.paddle(sensing.base_position, sensing.projected_gravity, sensing.heading, joints)[0]


def table(found: Senses) -> str:
    """One row per time since the reset."""
    rows = [
        [f"{time:g} s", *(f"{value:.2f}" if value < 2.0 else f"{value:.1f}" for value in row)]
        for time, row in zip(TIMES, found.errors.tolist(), strict=True)
    ]
    return markdown(["since the reset", *COLUMNS], rows)
