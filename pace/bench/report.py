"""The figures as one table and as JSON, each with the figures that it is compared with."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from pace.cores import usable_cores
from pace.runs.files import write_whole

FILE = "bench.json"

# name: title, unit, and the figures that it is compared with
FIGURES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "raw_mujoco_steps_per_s": ("mj_step alone, all cores", "steps/s", ()),
    "native_env_steps_per_s": ("environment, native engine", "steps/s", ("raw_mujoco_steps_per_s",)),
    "native_env_one_process_steps_per_s": ("the same in one process", "steps/s", ("raw_mujoco_steps_per_s",)),
    "raw_mujoco_2x_steps_per_s": ("mj_step alone, twice the worlds", "steps/s", ()),
    "native_env_2x_steps_per_s": ("environment, twice the worlds", "steps/s", ("raw_mujoco_2x_steps_per_s",)),
    "native_env_one_process_2x_steps_per_s": ("the same in one process", "steps/s", ("raw_mujoco_2x_steps_per_s",)),
    "mjwarp_env_steps_per_s": ("environment, MuJoCo Warp", "steps/s", ("native_env_steps_per_s",)),
    "ppo_fp32_samples_per_s": ("PPO update, fp32", "samples/s a pass", ("rsl_rl_fp32_samples_per_s",)),
    "rsl_rl_fp32_samples_per_s": ("rsl_rl's update, fp32", "samples/s a pass", ()),
    "ppo_bf16_samples_per_s": (
        "PPO update, bf16",
        "samples/s a pass",
        ("rsl_rl_bf16_samples_per_s", "matmul_bf16_samples_per_s"),
    ),
    "rsl_rl_bf16_samples_per_s": ("rsl_rl's update, mixed", "samples/s a pass", ()),
    "matmul_bf16_samples_per_s": ("its matrix products alone, bf16", "samples/s a pass", ()),
    "matmul_train_samples_per_s": ("matrix products of training, bf16", "samples/s a pass", ()),
    "matmul_train_12_samples_per_s": ("the same at 12 steps an update", "samples/s a pass", ()),
    "train_ideal_steps_per_s": ("ideal loop: mj_step, products", "steps/s", ()),
    "train_12_ideal_steps_per_s": ("the same at 12 steps an update", "steps/s", ()),
    "train_steps_per_s": (
        "training loop, default",
        "steps/s",
        ("raw_mujoco_steps_per_s", "train_ideal_steps_per_s"),
    ),
    "train_12_steps_per_s": ("the same at 12 steps an update", "steps/s", ("train_12_ideal_steps_per_s",)),
    "train_alone_steps_per_s": ("training, nothing beside it", "steps/s", ()),
    "train_beside_one_steps_per_s": ("training beside one busy process", "steps/s", ("train_alone_steps_per_s",)),
    "train_beside_two_steps_per_s": ("training beside two", "steps/s", ("train_alone_steps_per_s",)),
    "train_nice_beside_two_steps_per_s": ("the same at nice 10", "steps/s", ("train_alone_steps_per_s",)),
    "train_one_core_steps_per_s": ("training on one core (taskset)", "steps/s", ("train_alone_steps_per_s",)),
    "train_paper_steps_per_s": ("training loop, paper's networks", "steps/s", ("train_steps_per_s",)),
    "peak_memory_mib": ("peak memory of training", "MiB", ()),
    "peak_memory_4x_mib": ("the same, four times the worlds", "MiB", ()),
}


def ideals(measured: Mapping[str, float], passes: int) -> dict[str, float]:
    """The training loops that would only step physics at its limit and multiply matrices at theirs, one after the
    other: 1 / (1 / physics + passes / products), from what was measured in the same run."""
    physics, found = measured.get("raw_mujoco_steps_per_s"), {}
    for name in ("train", "train_12"):
        products = measured.get(f"matmul_{name}_samples_per_s")
        if physics is not None and products is not None:
            found[f"{name}_ideal_steps_per_s"] = 1.0 / (1.0 / physics + passes / products)
    return found


def ratios(figures: Mapping[str, float | None]) -> dict[str, float]:
    """``name/base``: quotient, for every pair of ``FIGURES`` that was measured."""
    found: dict[str, float] = {}
    for name, (_, _, bases) in FIGURES.items():
        for base in bases:
            value, reference = figures.get(name), figures.get(base)
            if value is not None and reference is not None:
                found[f"{name}/{base}"] = value / reference
    return found


def table(figures: dict[str, float | None]) -> str:
    """One line per figure: its title, its value, and its ratios to others."""
    quotients = ratios(figures)
    lines = []
    for name, (title, unit, bases) in FIGURES.items():
        value = figures.get(name)
        if value is None:
            continue
        shares = [f"{quotients[f'{name}/{b}']:.2f} x {FIGURES[b][0]}" for b in bases if f"{name}/{b}" in quotients]
        lines.append(f"{title:<34}{value:>10,.0f} {unit:<18}{'; '.join(shares)}".rstrip())
    return "\n".join(lines)


def complete(figures: dict[str, float]) -> dict[str, float | None]:
    """All names of ``FIGURES``; None for those not measured."""
    return {name: None if math.isnan(figures.get(name, math.nan)) else figures[name] for name in FIGURES}


def machine(device: torch.device) -> dict[str, Any]:
    """The machine of the measurements. ``load`` is its load average before the first one."""
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else None
    return {
        "cpu": _cpu_name(),
        "cores": usable_cores(),
        "gpu": gpu,
        "torch_threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
    }


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def write(path: Path, figures: dict[str, float | None], context: dict[str, Any]) -> None:
    """``bench.json``: the figures by name, their ratios, and the circumstances."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps({**figures, "ratios": ratios(figures), **context}, indent=1) + "\n")
