"""The cost of a robot's dry friction, and of the pairs of its geoms that touch each other, on each engine."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping

import mujoco
import torch

from pace.config.sim import RobotConfig
from pace.config.training import TrainConfig, load_train_config
from pace.runs.metrics import markdown
from pace.sim.engine.base import RobotEngine
from pace.sim.engine.factory import make_engine
from pace.studies.common import model_of, native_cost, study_config

DT = 0.01  # s
NATIVE_WORLDS, MJWARP_WORLDS = 256, 64
MJWARP_STEPS = 20  # physics steps of a rollout


def _frictionless(robot: RobotConfig) -> RobotConfig:
    groups = [dataclasses.replace(group, friction=0.0) for group in robot.joint_groups]
    return dataclasses.replace(robot, joint_groups=groups)


def robots() -> dict[str, RobotConfig]:
    """The robots of configs/, and ``t1`` and ``t1_29dof`` without parts of their description."""
    found = {name: load_train_config([f"robot={name}"]).robot for name in ("t1_paper", "t1", "t1_29dof")}
    for name in ("t1", "t1_29dof"):
        found[f"{name} without pairs"] = without = dataclasses.replace(found[name], self_collision=[])
        found[f"{name} without pairs and friction"] = _frictionless(without)
    return dict(sorted(found.items()))


def costs(repeats: int = 7) -> dict[str, tuple[float, float]]:
    """Robot -> processor time (s) of a physics step of one world, on one thread: native, MuJoCo Warp on a CPU."""
    config = study_config(physics_dt=DT)
    models = {case: model_of(dataclasses.replace(config, robot=robot)) for case, robot in robots().items()}
    native, mjwarp = native_cost(models, NATIVE_WORLDS, repeats), mjwarp_cost(config, models, repeats)
    return {case: (native[case], mjwarp[case]) for case in models}


def mjwarp_cost(config: TrainConfig, models: Mapping[str, mujoco.MjModel], repeats: int) -> dict[str, float]:
    """As :func:`pace.studies.common.native_cost`, on MuJoCo Warp's CPU device."""
    options = dataclasses.replace(config.engine, name="mjwarp")
    engines = {case: make_engine(model, options, MJWARP_WORLDS, "cpu", 1) for case, model in models.items()}
    least = dict.fromkeys(models, math.inf)
    for round_ in range(repeats + 1):
        for case, engine in engines.items():
            spent = _roll_out(engine, models[case])
            least[case] = min(least[case], spent) if round_ else math.inf  # the first one compiles and records
    return {case: spent / (MJWARP_WORLDS * MJWARP_STEPS) for case, spent in least.items()}


def _roll_out(engine: RobotEngine, model: mujoco.MjModel) -> float:
    """Processor time (s) of MJWARP_STEPS physics steps from the nominal pose, whose targets jump."""
    everyone = torch.ones(MJWARP_WORLDS, dtype=torch.bool)
    start = torch.as_tensor(model.key_qpos[0], dtype=torch.float32).repeat(MJWARP_WORLDS, 1)
    jumps = 0.3 * torch.randn(MJWARP_WORLDS, 1, model.nu, generator=torch.Generator().manual_seed(3))
    targets, still = start[:, None, 7:] + jumps, torch.zeros(MJWARP_WORLDS, model.nv)
    engine.reset(everyone, start, still)
    started = time.process_time()
    for _ in range(MJWARP_STEPS):
        engine.advance(targets, still)
    return time.process_time() - started


def table(found: Mapping[str, tuple[float, float]]) -> str:
    """A row per robot: microseconds a physics step of a world, native; the same and steps a second, MuJoCo Warp."""
    header = ["robot", "native, us", "mjwarp on a CPU, us", "steps a second"]
    rows = [
        [case, f"{1e6 * native:.1f}", f"{1e6 * mjwarp:.0f}", f"{1 / mjwarp:.0f}"]
        for case, (native, mjwarp) in found.items()
    ]
    return markdown(header, rows)
