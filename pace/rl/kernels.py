"""The kernels of a training run, compiled before it begins: ``python -m pace.rl.warm``, and the start of a run.

On a machine without compiled kernels, a run on a GPU would compile one module after another in its first updates.
"""

from __future__ import annotations

import re
import time
from dataclasses import replace

import torch
import warp as wp
from omegaconf import DictConfig

from pace.arrays.warm import Target, Wanted, cache_folder, compile_kernels, missing, rehearsal
from pace.config.base import ConfigError, parse
from pace.config.commands import WarmConfig
from pace.config.overrides import stage_tasks
from pace.config.training import TrainConfig
from pace.cores import usable_cores
from pace.devices import resolve_device
from pace.predictor.network import make_predictor
from pace.predictor.priors import resolve_priors

WORLDS = 2  # of a rehearsal: kernels do not depend on the number of worlds


def warm_from_config(composed: DictConfig) -> None:
    """Compile what the configured run needs, for its device or for the GPU ``arch``."""
    config = parse(composed, WarmConfig)
    if config.arch is None:
        device = resolve_device(config.device)
        compiled = warm(config, device)
        print(f"{'compiled' if compiled else 'nothing to compile'} for {device}: kernels are in {cache_folder()}")
        return
    arch = architecture(config.arch)
    compiled = _compile_missing(kernels_of_a_gpu(config), Target(arch=arch))
    print(f"{'compiled' if compiled else 'nothing to compile'} for sm_{arch}: kernels are in {cache_folder()}")


def architecture(name: str) -> int:
    """90 of ``sm_90``. Errors: :class:`ConfigError` for another form, and for what Warp's compiler does not know."""
    form = re.fullmatch(r"(?:sm_)?(\d+)", name)
    known = sorted(wp._src.context.runtime.nvrtc_supported_archs)
    if form is None or int(form[1]) not in known:
        can = ", ".join(f"sm_{arch}" for arch in known) or "nothing on this system"
        raise ConfigError(f"arch must be one that Warp can compile for ({can}), not {name}")
    return int(form[1])


def warm(config: TrainConfig, device: torch.device) -> int:
    """Compile what a run of ``config`` on ``device`` will load and Warp's folder does not hold; returns the number."""
    wanted = kernels_of_a_gpu(config) if device.type == "cuda" else kernels_of(config, device)
    return _compile_missing(wanted, Target(wp.device_from_torch(device)))


def _compile_missing(wanted: list[Wanted], target: Target) -> int:
    absent, started = missing(wanted, target), time.monotonic()
    if absent:
        workers = min(usable_cores(), len(absent))
        print(f"compiling kernels: {len(absent)} modules, {workers} at a time", flush=True)
        compile_kernels(absent, target, workers)
        print(f"compiled in {time.monotonic() - started:.0f} s", flush=True)
    return len(absent)


def kernels_of_a_gpu(config: TrainConfig) -> list[Wanted]:
    """The modules of a run on a GPU, found on a CPU in the way of a GPU: the GPU is not touched."""
    name = "mjwarp" if config.engine.name in ("auto", "native") else config.engine.name
    as_there = replace(config, engine=replace(config.engine, name=name, graph="dry"))
    return kernels_of(as_there, torch.device("cpu"), of_a_gpu=True)


def kernels_of(config: TrainConfig, device: torch.device, of_a_gpu: bool = False) -> list[Wanted]:
    """The modules of a run, found in a rehearsal of two worlds for each of its stages: a robot brings its own, and so
    do pauses, motion capture and whatever else a stage switches on. All but the first take half a second."""
    found: list[Wanted] = []
    for task in stage_tasks(config):
        found += [each for each in _rehearse(task, device, of_a_gpu) if each not in found]
    return found


def _rehearse(task: TrainConfig, device: torch.device, of_a_gpu: bool) -> list[Wanted]:
    from pace.task.env import TableTennisEnv  # loads the simulation, which takes seconds

    predictor = make_predictor(resolve_priors(task)).to(device)
    with rehearsal(of_a_gpu) as found, torch.no_grad():
        env = TableTennisEnv(task, WORLDS, device, task.seed, predictor)
        env.advance(torch.zeros(env.action_spec.shape, device=device))
        env.reset_worlds(torch.ones(WORLDS, dtype=torch.bool, device=device))
    return found
