"""A measurement of this machine from its configuration.

All figures are measured in one run; those to be compared are measured in turn.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pace.bench import neighbours, physics, report, training, update
from pace.config.automatic import choose
from pace.config.base import parse
from pace.config.commands import BenchConfig
from pace.cores import usable_cores
from pace.devices import machine_of, resolve_device
from pace.runs.own_files import make_out
from pace.runs.run_folder import versions

BUSY_LOAD = 0.5  # per core; a higher load gives a warning


def bench_from_config(composed: DictConfig) -> None:
    """Measure as configured; print the table, write the JSON, print its path."""
    machine = machine_of(resolve_device(str(composed.device)))
    config = parse(choose(composed, machine)[0], BenchConfig)
    overrides = [o for o in HydraConfig.get().overrides.task if not o.lstrip("+~").startswith("bench")]
    path = make_out(config.out, config.name, [report.FILE]) / report.FILE
    measure(config, overrides, path)
    print(f"wrote {path}")


def measure(config: BenchConfig, overrides: list[str], path: Path) -> dict[str, Any]:
    """Run the parts that ``config`` names, print the table and write it to ``path``; returns the figures by name.

    ``overrides`` are those of ``config`` that concern training: the training loop runs as a separate command.
    """
    device = resolve_device(config.device)
    machine = report.machine(device)
    if machine["load"] > BUSY_LOAD:
        print(f"the machine is busy (load {machine['load']:.1f} on {usable_cores()} cores): figures will be low")
    parts = {
        "physics": lambda: physics.native_rates(config),
        "mjwarp": lambda: physics.mjwarp_rates(config, device),
        "update": lambda: update.update_rates(config, device),
        "train": lambda: training.train_rates(config, overrides) | update.product_rates(config, device),
        "neighbours": lambda: neighbours.neighbour_rates(config, overrides),
        "memory": lambda: training.memory_peak(config, overrides),
    }
    measured: dict[str, float] = {}
    for name in config.bench.parts:
        print(f"measuring {name} ...", flush=True)
        started = time.perf_counter()
        measured |= parts[name]()
        print(f"  {time.perf_counter() - started:.0f} s", flush=True)
    figures = report.complete(measured | report.ideals(measured, config.algo.epochs))
    settings = {"num_worlds": config.num_worlds, "physics_steps": config.substeps, "repeats": config.bench.repeats}
    report.write(path, figures, {"settings": settings, "device": str(device), "machine": machine, **versions()})
    print(report.table(figures))
    return figures
