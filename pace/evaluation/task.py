"""The task that an evaluation plays: one for every policy, or the policy's own.

A row sets the launch of its serves, spin included, for either. Pauses are the task's: none, or the policy's own.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pace.config.base import compose, parse, to_dict
from pace.config.sim import RobotConfig
from pace.config.task import SPINS, ServeConfig
from pace.config.training import TrainConfig
from pace.rl.policies import TaskPolicy
from pace.sim.robot import joint_gains, joint_group
from pace.sim.robot_spec import RobotSpec

#: Parts of the default training task that ``task=table`` plays; serves are the rows', resets the evaluation's.
TABLE_PARTS = ("robot", "ball", "engine", "randomization", "sensing")
#: Parts whose differences are told; a solver makes no other task.
TOLD_PARTS = ("robot", "ball", "randomization", "sensing")
#: Of the serves, what rows do not set.
PAUSES = ("pause", "first_pause", "pause_ball")
#: Of the serves, what rows set.
LAUNCH = ("x", "y", "z", "vx", "vy", "vz", *SPINS, "speed", "bounce_x", "bounce_y")
#: Differences in one part that are listed; more are counted.
LISTED = 3


def policy_on(task: str, policy: TaskPolicy) -> TaskPolicy:
    """``policy`` on the ``task``: ``own``, as it was saved, or ``table``, the default one of ``configs/train.yaml``.

    With ``table``, what the policy's controller is made of stays its own: rate and scale of its actions, nominal pose,
    gains. So does a robot with other joints than the default one.
    """
    return policy if task == "own" else replace(policy, config=table_task(policy.config))


def table_task(config: TrainConfig) -> TrainConfig:
    """``config`` with the parts ``TABLE_PARTS`` of the default training task, and the controller of its own robot."""
    usual = parse(compose("train"), TrainConfig)
    parts = {name: getattr(usual, name) for name in TABLE_PARTS}
    parts["robot"] = _with_controller(usual.robot, config.robot)
    parts["engine"] = replace(usual.engine, name=config.engine.name, threads=config.engine.threads)
    serve = replace(config.serve, **{name: getattr(usual.serve, name) for name in PAUSES})  # as in every row
    return replace(config, serve=serve, **parts)


def _with_controller(robot: RobotConfig, own: RobotConfig) -> RobotConfig:
    """``robot`` with the controller of ``own``; ``own`` itself if its joints differ."""
    joints = RobotSpec.of(robot).joints
    if joints != RobotSpec.of(own).joints:
        return own
    kept = ("control_dt", "action_scale", "action_clip", "nominal_pose")
    changed = replace(robot, **{name: getattr(own, name) for name in kept})
    gains = joint_gains(own)[:2]
    if np.array_equal(joint_gains(robot)[:2], gains):
        return changed
    by_joint = zip(joints, gains.T.tolist(), strict=True)
    groups = [replace(joint_group(robot, name), match=[name], kp=kp, kd=kd) for name, (kp, kd) in by_joint]
    return replace(changed, joint_groups=groups)


def differences(own: TrainConfig, played: TrainConfig) -> list[str]:
    """How the task ``own`` differs from the one that is ``played``, by part: the name of its choice, or its values; of
    the serves their pauses, because rows set the rest."""
    told = [_difference(name, to_dict(getattr(own, name)), to_dict(getattr(played, name))) for name in TOLD_PARTS]
    pauses = [f"serve.{name}" for name in PAUSES if getattr(own.serve, name) != getattr(played.serve, name)]
    return [text for text in told if text] + (pauses if own.serve.has_pauses or played.serve.has_pauses else [])


def _difference(part: str, own: dict[str, Any], played: dict[str, Any]) -> str:
    if own["name"] != played["name"]:
        return f"{part}={own['name']}"
    changed = [key for key in own if own[key] != played.get(key)]
    if len(changed) > LISTED:
        return f"{len(changed)} values of {part}"
    return ", ".join(f"{part}.{key}" for key in changed)


def own_pauses(task: str, config: TrainConfig) -> list[str]:
    """Overrides that give the rows of ``task=own`` the pauses of ``config``; empty without pauses, or for the table."""
    serve = config.serve
    if task != "own" or not serve.has_pauses:
        return []
    ranges = [f"serve.{name}=[{low},{high}]" for name, (low, high) in _pause_ranges(serve)]
    return ranges + [f"serve.pause_ball.{does}={share}" for does, share in serve.pause_ball.items()]


def _pause_ranges(serve: ServeConfig) -> list[tuple[str, list[float]]]:
    return [("pause", serve.pause), ("first_pause", serve.first_pause)]


def task_line(task: str, saved: TrainConfig, played: TrainConfig) -> str:
    """One line: the task that is played, and how the policy's own one differs."""
    parts = [f"{name}={getattr(played, name).name}" for name in TOLD_PARTS]
    if played.serve.has_pauses:
        parts += [f"serve.{name}=[{low:g},{high:g}] s" for name, (low, high) in _pause_ranges(played.serve)]
    line = f"task={task}: {', '.join(parts)}"
    if task != "own":
        told = differences(saved, played)
        line += f"; task=own has {', '.join(told)}" if told else "; task=own is the same"
    served = _served(saved.serve)
    return f"{line}; trained with {', '.join(served)}, which the rows set" if served else line


def _served(serve: ServeConfig) -> list[str]:
    """What a policy was trained with of what rows set: another choice of serves than the usual, or other ranges."""
    usual = parse(compose("train"), TrainConfig).serve
    if serve.name != usual.name:
        return [f"serve={serve.name}"]
    return [f"serve.{name}" for name in LAUNCH if getattr(serve, name) != getattr(usual, name)]
