"""Control steps a second: MuJoCo alone on all cores, and the whole environment on either engine."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pace.bench.environment import EnvironmentLoop, EnvironmentProcesses
from pace.bench.timing import median_seconds
from pace.config.commands import BenchConfig
from pace.cores import usable_cores
from pace.distributed import suitable_size


class RawMujoco:
    """``mj_step`` alone: one thread a core, each with its own MjData, taking the worlds one by one.

    One C call steps a world through all its control steps, so neither Python nor cache misses between worlds cost time:
    this is an upper limit, not a usable loop.
    """

    def __init__(self, model: mujoco.MjModel, physics_steps: int) -> None:
        self.model, self.physics_steps = model, physics_steps
        self.threads = usable_cores()
        self._data = [mujoco.MjData(model) for _ in range(self.threads)]
        self._pool = ThreadPoolExecutor(self.threads)
        self.qpos = self.qvel = self.ctrl = np.zeros((0, 0))

    def start_from(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor) -> None:
        """Set the states (N, nq), (N, nv) and joint targets (N, nu) rad at the start of every :meth:`run`."""
        self.qpos, self.qvel, self.ctrl = (_double(values) for values in (qpos, qvel, ctrl))

    def run(self) -> None:
        """Step all worlds ``physics_steps`` times."""
        worlds = iter(range(len(self.qpos)))  # shared: taking the next one is atomic
        for _ in self._pool.map(lambda data: self._step_worlds(data, worlds), self._data):
            pass

    def _step_worlds(self, data: mujoco.MjData, worlds: Iterator[int]) -> None:
        for world in worlds:
            data.qpos[:], data.qvel[:], data.ctrl[:] = self.qpos[world], self.qvel[world], self.ctrl[world]
            data.qacc_warmstart[:] = 0.0
            mujoco.mj_step(self.model, data, self.physics_steps)


def _double(values: Tensor) -> NDArray[np.float64]:
    return values.cpu().double().numpy().copy()


def native_rates(config: BenchConfig) -> dict[str, float]:
    """Raw MuJoCo and the native environment in turn, with ``num_worlds`` worlds and with twice as many.

    The environment runs in as many processes as training has, and in one process with a thread per core. The latter and
    raw MuJoCo begin with the same states and hold the same joint targets; the other processes use states and targets of
    the same distribution.
    """
    twice = copy.deepcopy(config)
    twice.num_worlds = 2 * config.num_worlds
    doubled = {name.replace("_steps", "_2x_steps"): rate for name, rate in _native_rates(twice).items()}
    return _native_rates(config) | doubled


def _native_rates(config: BenchConfig) -> dict[str, float]:
    steps, cpu = config.bench.control_steps, torch.device("cpu")
    loop = EnvironmentLoop(config, "native", cpu, steps)
    worlds = loop.env.worlds
    raw = RawMujoco(worlds.model, steps * config.substeps)
    loop.play(config.bench.settle_steps)

    def same_start() -> None:
        loop.sample()
        qpos, qvel = worlds.engine.qpos_path[:, -1], worlds.engine.qvel_path[:, -1]
        raw.start_from(qpos, qvel, worlds.nominal + config.robot.action_scale * loop.action)

    with EnvironmentProcesses(config, "native", suitable_size(config.num_worlds, cpu)) as processes:
        measured = {"raw": raw.run, "native": processes.run, "one_process": loop.run}
        seconds = median_seconds(measured, config.bench.repeats, cpu, same_start)
    samples = config.num_worlds * steps
    return {
        "raw_mujoco_steps_per_s": samples / seconds["raw"],
        "native_env_steps_per_s": samples / seconds["native"],
        "native_env_one_process_steps_per_s": samples / seconds["one_process"],
    }


def mjwarp_rates(config: BenchConfig, device: torch.device) -> dict[str, float]:
    """The whole environment on MuJoCo Warp, on ``device``."""
    steps = config.bench.mjwarp_steps
    loop = EnvironmentLoop(config, "mjwarp", device, steps)
    if device.type == "cuda":
        loop.play(config.bench.settle_steps)
    seconds = median_seconds({"mjwarp": loop.run}, config.bench.repeats, device, loop.sample)
    return {"mjwarp_env_steps_per_s": config.num_worlds * steps / seconds["mjwarp"]}
