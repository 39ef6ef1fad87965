"""The engine that a configuration names: one of the package, or one from outside (:mod:`pace.config.plugins`)."""

from __future__ import annotations

from typing import Protocol, cast

import mujoco
import torch

from pace.arrays.graph import Graphs, graphs_of
from pace.config import plugins
from pace.config.sim import EngineConfig
from pace.devices import resolve_device
from pace.sim.engine.base import RobotEngine


class MakesEngine(Protocol):
    """A class that meets :class:`RobotEngine`, or a function that makes one."""

    def __call__(
        self, model: mujoco.MjModel, options: EngineConfig, num_worlds: int, device: torch.device, substeps: int, /
    ) -> RobotEngine:
        """N worlds of ``model``, in its nominal keyframe; ``substeps``: physics steps of one control step."""
        ...


def _native(
    model: mujoco.MjModel, options: EngineConfig, num_worlds: int, device: torch.device, substeps: int
) -> RobotEngine:
    from pace.sim.engine.native import NativeEngine

    return NativeEngine(model, options, num_worlds, device, substeps)


def _mjwarp(
    model: mujoco.MjModel, options: EngineConfig, num_worlds: int, device: torch.device, substeps: int
) -> RobotEngine:
    from pace.sim.engine.mjwarp import MjwarpEngine  # loads MuJoCo Warp, which takes seconds

    return MjwarpEngine(model, options, num_worlds, device, substeps)


def _accept(found: object) -> MakesEngine:
    if not callable(found):
        raise TypeError("a class that meets pace.sim.engine.base.RobotEngine, or a function that makes one")
    return cast(MakesEngine, found)


#: All engines by ``engine.name``; ``auto`` is one of them.
ENGINES: plugins.Registry[MakesEngine] = plugins.Registry(
    "engine", plugins.ENGINES, _accept, {"native": _native, "mjwarp": _mjwarp}, where="engine.name="
)


def make_engine(
    model: mujoco.MjModel, engine: EngineConfig, num_worlds: int, device: str | torch.device, substeps: int
) -> RobotEngine:
    """N worlds of ``model`` on ``device``. Engine ``auto`` is mjwarp on a GPU and native on the CPU.

    Args: substeps: physics steps of one control step. The worlds start in the model's nominal keyframe.
    Errors: :class:`ConfigError` for an unknown engine, a device that is not there, or that the engine or CUDA graphs
    cannot use.
    """
    where = resolve_device(device)
    a_gpus = where.type == "cuda" or graphs_of(engine, where) is Graphs.DRY
    name = engine.name if engine.name != "auto" else ("mjwarp" if a_gpus else "native")
    return ENGINES[name](model, engine, num_worlds, where, substeps)
