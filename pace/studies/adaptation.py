"""Adaptation of a policy to its paddle: success by the serve, on unknown paddles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

from pace.evaluation.records import COLUMNS, C, wilson
from pace.evaluation.serves import ServeRecorder, play
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.metrics import markdown
from pace.sim.robot_spec import RobotSpec
from pace.studies.common import COLOURS, ENDLESS
from pace.task.env import TableTennisEnv
from pace.task.observations import POLICY, layout
from pace.task.outcome import Outcome

HIT_SPEED = 6.0  # m/s along the normal, at which restitutions are compared
#: Restitution at HIT_SPEED below which a paddle belongs to the group; randomization=wide goes from 0.38 to 0.87.
GROUPS = {"dead": 0.54, "middling": 0.71, "lively": 1.0}
SERVES = 8
SEED = 5


@dataclass(frozen=True)
class Adaptation:
    """Successes (N, serves) bool of worlds that never fell, and the restitution of their paddles (N,)."""

    policy: str
    success: Tensor
    restitution: Tensor


class Forgetful:
    """A policy whose memory is replaced by its value before the first return: zeros."""

    def __init__(self, policy: TaskPolicy) -> None:
        names, frames = policy.config.observation.policy, policy.config.observation.policy_history
        columns = layout(names, POLICY, len(RobotSpec.of(policy.config.robot).joints))["last_return"]
        self._policy, self._frames, self._columns = policy, frames, columns

    def __call__(self, observation: Tensor) -> Tensor:
        blank = observation.view(observation.shape[0], self._frames, -1).clone()
        blank[:, :, self._columns] = 0.0
        return self._policy(blank.flatten(1))


def adapt(run: Path, worlds: int, forgetful: bool = False) -> Adaptation:
    """Play the first ``SERVES`` mixed serves of ``worlds`` robots, each with a different paddle and ball.

    ``forgetful``: with the memory blanked (of a policy that has ``last_return``).
    """
    policy = load_policy(run)
    env = policy.make_env(worlds, "cpu", SEED, [*ENDLESS, "randomization=wide"])
    restitution = _restitution(env)
    recorder = ServeRecorder(env, 0, SERVES)
    play(env, Forgetful(policy) if forgetful else policy, recorder)  # type: ignore[arg-type]  # only called
    records = recorder.records[:-1].view(worlds, SERVES, len(COLUMNS))
    stood = (records[..., C["fall"]] == 0).all(1)  # after a fall the paddle is resampled
    success = records[..., C["outcome"]] == Outcome.SUCCESS
    name = f"{run.name}, memory blanked" if forgetful else run.name
    return Adaptation(name, success[stood], restitution[stood])


def _restitution(env: TableTennisEnv) -> Tensor:
    ball = env.worlds.ball.params
    drop = torch.as_tensor(ball.paddle_restitution_slope) * HIT_SPEED
    return (torch.as_tensor(ball.paddle_restitution) - drop).clone()


def adaptations(runs: Sequence[Path], worlds: int) -> list[Adaptation]:
    """Every policy, and each one that has a memory also without it."""
    found = []
    for run in runs:
        remembers = "last_return" in load_policy(run).config.observation.policy
        for forgetful in (False, True) if remembers else (False,):
            found.append(adapt(run, worlds, forgetful))
            print(f"{found[-1].policy}: done", flush=True)
    return found


def groups(found: Adaptation) -> dict[str, Tensor]:
    """Successes (M, serves) of all worlds, and of each group of paddles."""
    result, lowest = {"all": found.success}, 0.0
    for name, highest in GROUPS.items():
        chosen = (found.restitution >= lowest) & (found.restitution < highest)
        result[f"{name} ({max(lowest, 0.38):.2f} to {min(highest, 0.87):.2f})"] = found.success[chosen]
        lowest = highest
    return result


def table(found: Sequence[Adaptation]) -> str:
    """One row per policy and group of paddles: success (%) of each serve, with the half width of its 95 % interval."""
    rows = []
    for adaptation in found:
        for name, success in groups(adaptation).items():
            cells = []
            for serve in range(SERVES):
                count, total = int(success[:, serve].sum()), success.shape[0]
                low, high = wilson(count, total)
                cells.append(f"{100 * count / max(total, 1):.1f} ± {50 * (high - low):.1f}")
            rows.append([adaptation.policy, name, str(success.shape[0]), *cells])
    return markdown(["policy", "paddle", "worlds", *(f"serve {serve + 1}" for serve in range(SERVES))], rows)


def draw(found: Sequence[Adaptation], figure: Figure) -> None:
    """Success by the serve, a panel for each group of paddles."""
    names = list(groups(found[0]))
    serves = range(1, SERVES + 1)
    axes = figure.subplots(1, len(names), sharey=True)
    for panel, (axis, name) in enumerate(zip(axes, names, strict=True)):
        for colour, adaptation in zip(cycle(COLOURS), found, strict=False):
            success = list(groups(adaptation).values())[panel]
            ends = [wilson(int(success[:, serve].sum()), success.shape[0]) for serve in range(SERVES)]
            axis.plot(serves, 100 * success.float().mean(0), color=colour, marker="o", ms=3, label=adaptation.policy)
            axis.fill_between(serves, *(100 * torch.tensor(ends).T), color=colour, alpha=0.15, lw=0)
        axis.set(title=name, xlabel="serve on an unknown paddle", xticks=serves)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("success (%)")
    axes[0].legend(fontsize=7)
