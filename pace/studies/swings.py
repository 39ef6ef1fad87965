"""Motions to replay: states and joint targets of control steps, from a policy's rollout or from random swings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pace.rl.policies import load_policy
from pace.sim.worlds import Worlds
from pace.studies.common import smooth_swings, standing_worlds, study_config

RECORDED_DT = 0.002  # s, physics step of the recording
SEED = 7


@dataclass(frozen=True)
class Swings:
    """T control steps of N worlds. ``qpos`` (T, N, 7 + J), ``qvel`` (T, N, 6 + J): the state before each step;
    ``targets`` (T, N, J) rad: the joint targets in it; ``ends`` (T, N) bool: the world is reset after
    it; ``source``."""

    qpos: Tensor
    qvel: Tensor
    targets: Tensor
    ends: Tensor
    source: str

    def windows(self, length: int) -> Windows:
        """All stretches of ``length`` control steps without a reset, one after the other."""
        starts = range(0, len(self.ends) - length + 1, length)
        whole = [~self.ends[at : at + length - 1].any(0) for at in starts]
        cut = [self.targets[at : at + length][:, keep] for at, keep in zip(starts, whole, strict=True)]
        return Windows(
            torch.cat([self.qpos[at][keep] for at, keep in zip(starts, whole, strict=True)]),
            torch.cat([self.qvel[at][keep] for at, keep in zip(starts, whole, strict=True)]),
            torch.cat(cut, dim=1),
        )


@dataclass(frozen=True)
class Windows:
    """W stretches of motion: states (W, 7 + J), (W, 6 + J) at their start, and ``targets`` (L, W, J) rad."""

    qpos: Tensor
    qvel: Tensor
    targets: Tensor


def random_swings(num_worlds: int, steps: int) -> Swings:
    """A standing robot whose arm follows random sines."""
    config = study_config(physics_dt=RECORDED_DT)
    worlds = standing_worlds(config, num_worlds)
    targets = smooth_swings(worlds.nominal, num_worlds, steps, SEED, arm=0.6, rest=0.03)
    states = []
    for step in range(steps):
        states.append(_state(worlds))
        worlds.step(targets[step])
    qpos, qvel = (torch.stack(part) for part in zip(*states, strict=True))
    return Swings(qpos, qvel, targets, torch.zeros(steps, num_worlds, dtype=torch.bool), "random swings")


def policy_swings(run: Path, num_worlds: int, steps: int) -> Swings:
    """Motions of a trained policy, from a run folder or checkpoint, that plays serves with the default robot, without
    randomisation."""
    policy = load_policy(run)
    robot = f"robot={study_config().robot.name}"  # in which the studies replay them
    changes = [robot, "engine=native", f"engine.physics_dt={RECORDED_DT}", "engine.threads=1", "randomization=none"]
    env = policy.make_env(num_worlds, "cpu", SEED, changes)
    worlds, action_scale = env.worlds, policy.config.robot.action_scale
    states, targets, ends = [], [], []
    for _ in range(steps):
        states.append(_state(worlds))
        env.advance(policy(env.policy_observation))
        targets.append(worlds.nominal + action_scale * env.task_state.action)
        done = env.terminated | env.truncated
        ends.append(done.clone())
        env.reset_worlds(done)
    qpos, qvel = (torch.stack(part) for part in zip(*states, strict=True))
    return Swings(qpos, qvel, torch.stack(targets), torch.stack(ends), f"policy {policy.source}")


def _state(worlds: Worlds) -> tuple[Tensor, Tensor]:
    return worlds.engine.qpos_path[:, -1].clone(), worlds.engine.qvel_path[:, -1].clone()
