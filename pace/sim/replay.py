"""The last control steps of each world, kept for the event that something goes wrong, and their file.

A replay is one safetensors file, so that reading it runs no code. It holds the states at the beginning of the steps,
and the configuration that the viewer needs to show them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import warp as wp
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from pace.arrays.launch import Launch
from pace.config.upgrade import FORMAT as CONFIG_FORMAT
from pace.config.upgrade import upgrade_config
from pace.sim.ball.state import BallArrays, BallState
from pace.sim.engine.base import EngineArrays, RobotEngine

FORMAT = 1
BALL = wp.constant(9)  # numbers of a ball: position, velocity and spin


class ReplayError(OSError):
    """A replay that cannot be read or written; the message names the file and the reason."""


@wp.kernel
def _remember(
    engine: EngineArrays,
    ball: BallArrays,
    targets: wp.array2d[wp.float32],
    step: wp.array[wp.int32],
    memory: wp.array3d[wp.float32],
):
    """Store the state of one world in place of the oldest: qpos, qvel, the ball, and the targets of the coming step."""
    world = wp.tid()
    slot = step[0] % memory.shape[1]
    last = engine.qpos_path.shape[1] - 1
    nq = engine.qpos_path.shape[2]
    nv = engine.qvel_path.shape[2]
    for i in range(nq):
        memory[world, slot, i] = engine.qpos_path[world, last, i]
    for i in range(nv):
        memory[world, slot, nq + i] = engine.qvel_path[world, last, i]
    for axis in range(3):
        memory[world, slot, nq + nv + axis] = ball.position[world][axis]
        memory[world, slot, nq + nv + 3 + axis] = ball.velocity[world][axis]
        memory[world, slot, nq + nv + 6 + axis] = ball.spin[world][axis]
    for i in range(targets.shape[1]):
        memory[world, slot, nq + nv + BALL + i] = targets[world, i]


@dataclass(frozen=True)
class WorldReplay:
    """One world's last T control steps: the states at their beginnings, oldest first; the event is in the last one."""

    world: int
    qpos: Tensor  # (T, 7 + J)
    qvel: Tensor  # (T, 6 + J)
    ball: Tensor  # (T, 9) m, m/s, rad/s: position, velocity, spin
    targets: Tensor  # (T, J) rad


class Recorder:
    """Remembers the last ``steps`` control steps of N worlds, on their device.

    Args: step: (1,) int32, control steps so far, counted by its owner after each :meth:`remember`.
    """

    def __init__(self, engine: RobotEngine, ball: BallState, joints: int, steps: int, step: Tensor) -> None:
        count, _, nq = engine.qpos_path.shape
        self._step, self._widths = step, (nq, engine.qvel_path.shape[2], 9, joints)
        self.memory = torch.zeros(count, steps, sum(self._widths), device=step.device)
        self._targets = torch.zeros(count, joints, device=step.device)
        given = {"engine": engine, "ball": ball, "targets": self._targets, "step": step, "memory": self.memory}
        self._remember = Launch(_remember, count, step.device, **given)

    def remember(self, targets: Tensor) -> None:
        """Store the states before a control step towards ``targets`` (N, J) rad."""
        self._targets.copy_(targets)
        self._remember()

    def replay(self, world: int, when: int) -> WorldReplay:
        """The steps of a world up to number ``when``, from 1 on, as far back as they are remembered. Waits."""
        steps = self.memory.shape[1]
        first = max(0, int(self._step) - steps)
        slots = [number % steps for number in range(first, when)]
        parts = self.memory[world, slots].cpu().split(self._widths, dim=1)
        return WorldReplay(world, *(part.contiguous() for part in parts))


def save_replay(file: Path, worlds: Sequence[WorldReplay], config: dict[str, Any], reason: str) -> Path:
    """Write the replays of some worlds, with the configuration of their task and what went wrong.

    Errors: :class:`ReplayError`.
    """
    names = ("qpos", "qvel", "ball", "targets")
    tensors = {f"{each.world}.{name}": getattr(each, name) for each in worlds for name in names}
    meta = {"format": FORMAT, "reason": reason, "worlds": [each.world for each in worlds]}
    meta |= {"config": config, "config_format": CONFIG_FORMAT}
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        save_file(tensors, file, {"replay": json.dumps(meta)})
    except (OSError, SafetensorError) as error:
        raise ReplayError(f"{file} cannot be written: {error}") from error
    return file


@dataclass(frozen=True)
class Replay:
    """A replay file in memory: ``config`` as saved, not yet checked."""

    worlds: list[WorldReplay]
    config: dict[str, Any]
    reason: str


def load_replay(file: Path) -> Replay:
    """Read the result of :func:`save_replay`. Errors: :class:`ReplayError`."""
    try:
        with safe_open(file, framework="pt") as opened:
            meta = json.loads((opened.metadata() or {}).get("replay", "null"))
            if not isinstance(meta, dict) or meta.get("format") != FORMAT:
                raise ReplayError(f"{file} is no replay of format {FORMAT}")
            worlds = [_world(opened, number) for number in meta["worlds"]]
            config = upgrade_config(dict(meta["config"]), int(meta["config_format"]))
            return Replay(worlds, config, str(meta["reason"]))
    except (OSError, SafetensorError, ValueError, KeyError, TypeError) as error:
        raise ReplayError(f"{file} cannot be read: {error}") from error


def _world(opened: Any, number: int) -> WorldReplay:
    parts = [opened.get_tensor(f"{number}.{name}") for name in ("qpos", "qvel", "ball", "targets")]
    if any(part.ndim != 2 or len(part) != len(parts[0]) or not len(part) for part in parts) or parts[2].shape[1] != 9:
        raise ValueError(f"the states of world {number} have the shapes {[tuple(part.shape) for part in parts]}")
    return WorldReplay(int(number), *parts)
