"""The exported file against torch, on observations recorded in the task."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pace.config.commands import ExportConfig
from pace.config.overrides import ON_A_CPU
from pace.config.training import TrainConfig
from pace.deploy.graph import StateLayout, input_ports, output_ports, readings
from pace.rl.policies import TaskPolicy
from pace.sim.sensing import STAMPS
from pace.task.env import TableTennisEnv

ACTION_NOISE = 0.3  # standard deviation added to the actions while observations are recorded, so that they vary
#: The check plays the task as saved, but for noise that is added to what the graph itself computes.
CHECK_OVERRIDES = ("sensing.base_shift=0.0", *ON_A_CPU)

Session = Any  # onnxruntime has no type information


class RawReadings:
    """The graph's inputs as a robot would give them, from the sensors of an environment's N worlds.

    Attributes: ``state`` (N, S), of the last call.
    """

    def __init__(self, env: TableTennisEnv, config: TrainConfig) -> None:
        self._env, self._action = env, StateLayout(config).columns["action"]
        self.state = torch.zeros(env.num_worlds, input_ports(config)["state"].size)

    def push(self, state: NDArray[np.float32]) -> None:
        """One control step later: ``state`` (N, S) that the graph gave. Its action becomes the one that was done."""
        self.state = torch.from_numpy(state)
        self.state[:, self._action] = self._env.task_state.action

    def restart(self, mask: Tensor) -> None:
        """Start from scratch in the worlds of ``mask`` (N,) bool."""
        self.state[mask] = 0.0

    def numpy(self) -> dict[str, NDArray[np.float32]]:
        """What onnxruntime takes."""
        sensing = self._env.sensing
        frame = {name: getattr(sensing, name) for name in readings(0)}
        frame["joint_position"] = sensing.joint_position + self._env.worlds.nominal
        frame |= {name: getattr(sensing, name).float().unsqueeze(1) for name in STAMPS}
        frame["state"] = self.state
        return {name: value.contiguous().numpy() for name, value in frame.items()}


def open_session(file: Path) -> Session:
    """The file in onnxruntime, on one thread of the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors
    return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])


def compare(
    session: Session, policy: TaskPolicy, config: ExportConfig, kept: list[dict[str, NDArray[np.float32]]] | None = None
) -> dict[str, float]:
    """Largest difference of each output to what the task itself computes, over recorded observations.

    Worlds play with the policy and some noise on its actions; serves follow one another and robots fall. The readings
    (1, size) of the first world are appended to ``kept``.
    """
    env = policy.make_env(config.check_worlds, "cpu", config.seed, CHECK_OVERRIDES)
    readings, names = RawReadings(env, policy.config), list(output_ports(policy.config))
    state = StateLayout(policy.config)
    generator = torch.Generator().manual_seed(config.seed)
    largest: dict[str, float] = {}
    for _ in range(config.check_steps):
        frame = readings.numpy()
        if kept is not None:
            kept.append({name: value[:1].copy() for name, value in frame.items()})
        found = dict(zip(names, session.run(None, frame), strict=True))
        memory = found["state_next"]
        found |= {name: memory[:, state.columns[name]] for name in env.actor.estimates}
        action = policy(env.policy_observation)
        for name, value in expected_outputs(env, policy, action).items():
            difference = float(np.abs(found[name] - value.numpy()).max())
            largest[name] = difference if np.isnan(difference) else max(largest.get(name, 0.0), difference)
        env.advance(action + ACTION_NOISE * torch.randn(action.shape, generator=generator))
        done = env.terminated | env.truncated
        readings.push(memory)
        env.reset_worlds(done)
        readings.restart(done)
    return largest


def expected_outputs(env: TableTennisEnv, policy: TaskPolicy, action: Tensor) -> dict[str, Tensor]:
    """The graph's outputs by name, and the states of the estimates in its state, as the environment has them."""
    robot, actor = policy.config.robot, env.actor
    clipped = action.clamp(-robot.action_clip, robot.action_clip)
    return {
        "joint_target": env.worlds.nominal + robot.action_scale * clipped,
        "action": clipped,
        "predicted_apex": actor.apex,
        "predicted_target": actor.target,
        "predicted_time": actor.time.unsqueeze(-1),
        "something_to_hit": actor.track.something_to_hit.float().unsqueeze(-1),
        **actor.estimates,
    }
