"""The engine that a configuration names."""

from __future__ import annotations

import mujoco
import torch

from pace.arrays.graph import graphs_wanted
from pace.config.sim import EngineConfig
from pace.devices import resolve_device
from pace.sim.engine.base import RobotEngine


def make_engine(
    model: mujoco.MjModel, engine: EngineConfig, num_worlds: int, device: str | torch.device, substeps: int
) -> RobotEngine:
    """N worlds of ``model`` on ``device``. Engine ``auto`` is mjwarp on a GPU and native on the CPU.

    Args: substeps: physics steps of one control step. The worlds stand in the model's nominal keyframe.
    Errors: :class:`ConfigError` for a device that is not there, or that the engine or CUDA graphs cannot use.
    """
    where = resolve_device(device)
    graphs_wanted(engine, where)
    name = engine.name if engine.name != "auto" else ("mjwarp" if where.type == "cuda" else "native")
    if name == "native":
        from pace.sim.engine.native import NativeEngine

        return NativeEngine(model, engine, num_worlds, where, substeps)
    from pace.sim.engine.mjwarp import MjwarpEngine  # loads MuJoCo Warp, which takes seconds

    return MjwarpEngine(model, engine, num_worlds, where, substeps)
