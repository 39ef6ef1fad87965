"""Common parts of the studies: configuration, robots on an engine, and tables."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import torch
from matplotlib.figure import Figure
from mujoco.batch import Batch
from numpy.typing import NDArray
from torch import Tensor

from pace.config.training import TrainConfig, load_train_config
from pace.runs.files import write_figure
from pace.sim.engine.native import stop_timers
from pace.sim.robot import build_model
from pace.sim.robot_spec import RobotSpec
from pace.sim.worlds import Worlds

Array = NDArray[np.float64]
COST_STEPS = 10
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")  # told apart by all kinds of vision
#: Overrides of a saved policy's task: mixed serves without episode ends, the paper's reset, 2 ms, one thread.
ENDLESS = (
    "reset=evaluation", "serve=mixed", "serve.serves_per_episode=0", "serve.end_after_hit=0",
    "engine=native", "engine.threads=1", "engine.physics_dt=0.002",
)  # fmt: skip


@lru_cache
def _clean_config() -> TrainConfig:
    return load_train_config(["randomization=none", "engine=native", "device=cpu"])


def study_spec() -> RobotSpec:
    """The parts of the default robot, for studies without a policy."""
    return RobotSpec.of(_clean_config().robot)


def carrying(spec: RobotSpec) -> list[int]:
    """Columns of the joints that carry the paddle: the arm, and a waist if there is one."""
    return [column for column, name in enumerate(spec.joints) if name in spec.arm or "Waist" in name]


def study_config(**engine: object) -> TrainConfig:
    """The training configuration without randomisation, on one thread, with values of ``engine`` changed."""
    config = _clean_config()
    options: dict[str, object] = {"threads": 1} | engine
    return dataclasses.replace(config, engine=dataclasses.replace(config.engine, **options))  # type: ignore[arg-type]


def standing(config: TrainConfig, num_worlds: int) -> Tensor:
    """States (N, 7 + J): nominal pose, soles on the floor, behind the table."""
    model = build_model(config.robot, config.engine, config.ball.table)
    qpos = torch.as_tensor(model.key_qpos[0], dtype=torch.float32).repeat(num_worlds, 1)
    qpos[:, 0] = -2.0
    return qpos


def standing_worlds(config: TrainConfig, num_worlds: int) -> Worlds:
    """Worlds on the CPU whose robots stand still as :func:`standing` says."""
    worlds = Worlds(config, num_worlds, "cpu")
    everyone = torch.ones(num_worlds, dtype=torch.bool)
    worlds.reset_robot(everyone, standing(config, num_worlds), torch.zeros(num_worlds, worlds.model.nv))
    return worlds


def smooth_swings(nominal: Tensor, num_worlds: int, steps: int, seed: int, arm: float, rest: float) -> Tensor:
    """Joint targets (T, N, J) rad round ``nominal`` (J,): a sum of three sines of 0.5 to 2.5 Hz a joint.

    ``arm`` is the amplitude of the joints that carry the paddle, ``rest`` that of all others.
    """
    generator = torch.Generator().manual_seed(seed)
    joints = nominal.shape[0]
    uniform = torch.rand(3, 3, num_worlds, joints, generator=generator)
    phase, frequency, share = 2 * np.pi * uniform[0], 0.5 + 2.0 * uniform[1], uniform[2]
    time = 0.02 * torch.arange(steps).view(-1, 1, 1, 1)
    wave = (share * torch.sin(2 * np.pi * frequency * time + phase)).sum(1)
    amplitude = torch.full((joints,), rest)
    amplitude[carrying(study_spec())] = arm
    return nominal + amplitude * wave


def model_of(config: TrainConfig) -> mujoco.MjModel:
    """The robot's model with the engine options of ``config``."""
    return build_model(config.robot, config.engine, config.ball.table)


def save_figure(file: Path, size: tuple[float, float], draw: Callable[[Figure], None]) -> None:
    """Draw a figure of ``size`` inches, write it to ``file`` and say so."""
    with plt.rc_context({"axes.spines.top": False, "axes.spines.right": False, "font.size": 9}):
        figure = plt.figure(figsize=size, layout="constrained")
        draw(figure)
        write_figure(file, figure, dpi=90)
        plt.close(figure)
    print(f"wrote {file}")


def quantiles(values: Array) -> tuple[float, float]:
    """Median and 95 % quantile of all values."""
    return float(np.median(values)), float(np.quantile(values, 0.95))


def native_cost(models: Mapping[str, mujoco.MjModel], worlds: int, repeats: int) -> dict[str, float]:
    """Processor time (s) of a physics step of one world, native, one thread: the least of ``repeats`` alternations.

    Standing robots whose targets jump, so that some motors saturate.
    """
    stop_timers()
    batches = {case: Batch(model, worlds, 1) for case, model in models.items()}
    least = dict.fromkeys(models, math.inf)
    for _ in range(repeats):
        for case, model in models.items():
            batch, jumps = batches[case], np.random.default_rng(3).normal(0.0, 0.3, (worlds, 1, model.nu))
            control = np.repeat(model.key_qpos[0, 7:] + jumps, COST_STEPS, axis=1)
            batch.bind("qpos")[:], batch.bind("qvel")[:] = model.key_qpos[0], 0.0
            batch.bind("qacc_warmstart")[:] = 0.0
            started = time.process_time()
            batch.rollout(COST_STEPS, control, int(mujoco.mjtState.mjSTATE_CTRL), ("qpos",))
            least[case] = min(least[case], time.process_time() - started)
    return {case: spent / (worlds * COST_STEPS) for case, spent in least.items()}
