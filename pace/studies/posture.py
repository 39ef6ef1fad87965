"""Qualitative behaviour of a policy: steps, hops, lean of the trunk and touches, at the ball and between serves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pace.evaluation.serves import ServeRecorder, play
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.metrics import markdown
from pace.studies.common import ENDLESS
from pace.task.env import TableTennisEnv

SEED = 7
#: Phases of play: with and without a ball that can be hit.
AT_BALL, WAITING = "at the ball", "waiting"
#: Means over the time of a phase: name, unit.
MEASURES = {
    "no foot on the floor": "% of time",
    "feet lifted": "/s",
    "feet sliding": "m/s",
    "speed of the base": "m/s",
    "lean of the trunk": "degrees",
}
SCALES = torch.tensor([100.0, 1.0, 1.0, 1.0, 1.0])


class PostureRecorder(ServeRecorder):
    """Posture and motion of the robots during play, including robots that are about to fall.

    Attributes: ``sums`` (2, len(MEASURES)): sums over instants of each phase, ``instants`` (2,); ``touches``
    (B,): number of instants at whose end each body of ``RobotSpec.contacts`` touched anything.
    """

    def __init__(self, env: TableTennisEnv, warmup_serves: int, quota: int) -> None:
        super().__init__(env, warmup_serves, quota)
        self.sums, self.instants = torch.zeros(2, len(MEASURES)), torch.zeros(2)
        self.touches = torch.zeros(len(env.worlds.spec.contacts))
        self._down = env.task_state.foot_contact.clone()

    def observe(self) -> None:
        state, robot = self.env.task_state, self.env.worlds.robot
        down = state.foot_contact
        lifted = (self._down & ~down).sum(1) / self.env.worlds.control_dt
        self._down.copy_(down)
        lean = torch.rad2deg(torch.acos((-robot.projected_gravity[:, 2]).clamp(-1.0, 1.0)))
        speed = robot.base_linear_velocity[:, :2].norm(dim=1)
        values = torch.stack(((~down).all(1).float(), lifted, state.measures["foot_slide"], speed, lean), dim=1)
        counted, something = self.counting.clone(), state.something_to_hit
        for phase, chosen in enumerate((something & counted, ~something & counted)):
            self.sums[phase] += values[chosen].sum(0)
            self.instants[phase] += chosen.sum()
        self.touches += robot.body_contact[counted].sum(0)
        super().observe()

    def begin(self) -> None:
        super().begin()
        self._down |= self.env.terminated.unsqueeze(1)  # a reset puts both feet down


@dataclass(frozen=True)
class Posture:
    """A policy's means in each phase (2, len(MEASURES)), in the units of MEASURES, its shares of time (2,), and the
    share of time in which each of its ``bodies`` touched anything."""

    policy: str
    bodies: tuple[str, ...]
    means: Tensor
    phases: Tensor
    touches: Tensor


def posture(policy: TaskPolicy, name: str, worlds: int, serves: int) -> Posture:
    """Play ``serves`` mixed serves of the saved task, 2 ms a physics step."""
    env = policy.make_env(worlds, "cpu", SEED, ENDLESS)
    recorder = PostureRecorder(env, 1, math.ceil(serves / worlds))
    play(env, policy, recorder)
    total = recorder.instants.sum()
    means = SCALES * recorder.sums / recorder.instants.unsqueeze(1)
    return Posture(name, env.worlds.spec.contacts, means, recorder.instants / total, recorder.touches / total)


def postures(runs: Sequence[Path], worlds: int, serves: int) -> list[Posture]:
    """Every policy of ``runs``."""
    return [posture(load_policy(run), run.name, worlds, serves) for run in runs]


def table(found: Sequence[Posture]) -> str:
    """A row per measure, a column per policy: at the ball / waiting; then touches of bodies other than the feet."""
    header = [f"{AT_BALL} / {WAITING}", *(one.policy for one in found)]
    rows = [["share of time, %", *(" / ".join(f"{100 * share:.0f}" for share in one.phases) for one in found)]]
    for column, (name, unit) in enumerate(MEASURES.items()):
        cells = (" / ".join(f"{value:.2f}" for value in one.means[:, column]) for one in found)
        rows.append([f"{name}, {unit}", *cells])
    rows.append(["touches, % of all time", *(_touches(one) for one in found)])
    return markdown(header, rows)


def _touches(one: Posture) -> str:
    seen = [
        f"{body.replace('_', ' ')} {100 * share:.2f}"
        for body, share in zip(one.bodies, one.touches.tolist(), strict=True)
        if share > 0
    ]
    return ", ".join(seen) or "none"
