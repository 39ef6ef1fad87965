"""Robustness sweep: the table under other balls, engines, sensors and bodies, one change at a time."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from pace.config.base import ConfigError, to_dict
from pace.config.commands import EvaluateConfig, VariationConfig
from pace.config.names import choices
from pace.config.overrides import override_task
from pace.config.realities import load_realities
from pace.config.sim import RandomizationConfig
from pace.config.training import TrainConfig
from pace.devices import resolve_device
from pace.evaluation.figures import DPI, heat_map
from pace.evaluation.report import write_json
from pace.evaluation.serves import EvaluationError
from pace.rl.policies import TaskPolicy
from pace.runs.files import write_figure

JSON, MAP = "sweep.json", "sweep.png"
FILES = (JSON, MAP)
SLOWNESS = 10.0  # times that mjwarp takes on a CPU (docs/results/speed.md), for the time that is left
Tables = dict[str, list[dict[str, Any]]]  # summaries of a cell's rows, by its key
#: Kinds of change by what they are called before their value in the heat map; others by their own name.
LABELS = {"noise": "sensing noise", "trunk_mass": "trunk mass", "gain": "joint gains", "pauses": "pauses of"}
LABELS |= dict.fromkeys(("spin", "sensing", "acting", "place"), "")


@dataclass(frozen=True)
class Variation:
    """One change of the task: its kind, its value, and its overrides."""

    kind: str
    value: str
    overrides: tuple[str, ...]

    @property
    def label(self) -> str:
        """Its label in the heat map."""
        return f"{LABELS.get(self.kind, self.kind)} {self.value}".strip()


def ball_presets() -> list[str]:
    """Names of configs/ball/, and those of the user's own folder."""
    return choices("ball")


def variations(task: TrainConfig, chosen: VariationConfig, reality: str | None = None) -> list[Variation]:
    """The unchanged task, then each change of ``chosen``, which starts from the values of ``task``, then the rows of
    ``configs/realities/<reality>.yaml``.

    Errors: :class:`ConfigError` that names the row, for one that does not fit the task.
    """
    sensing, bodies = task.sensing, task.randomization
    cells = [Variation("as given", "", ())]
    cells += [Variation("ball", name, (f"ball={name}",)) for name in chosen.ball or ball_presets()]
    cells += [Variation("engine", name, (f"engine={name}",)) for name in chosen.engine]
    for times in chosen.noise:
        louder = _range("sensing.noise_scale", [scale * times for scale in sensing.noise_scale])
        cells.append(Variation("noise", f"x {times:g}", (louder,)))
    for extra in chosen.latency:
        later = _range("sensing.mocap_delay", [delay + extra for delay in sensing.mocap_delay])
        cells.append(Variation("latency", f"+{1000 * extra:g} ms", (later,)))
    cells += [_shift(bodies, "friction", offset, "", lowest=0.05) for offset in chosen.friction]
    cells += [_shift(bodies, "trunk_mass", offset, " kg") for offset in chosen.trunk_mass]
    for times in chosen.gain:
        stronger = tuple(
            _range(f"randomization.{n}", [v * times for v in getattr(bodies, n)]) for n in ("kp_scale", "kd_scale")
        )
        cells.append(Variation("gain", f"x {times:g}", stronger))
    return cells + ([] if reality is None else _rows_of(task, reality))


def _rows_of(task: TrainConfig, reality: str) -> list[Variation]:
    rows = [
        Variation(kind, label, tuple(overrides))
        for kind, named in load_realities(reality).items()
        for label, overrides in named.items()
    ]
    for row in rows:
        try:
            override_task(task, row.overrides)
        except ConfigError as error:
            raise ConfigError(f"reality={reality}, {row.kind}, {row.value}: {error}") from error
    return rows


def _shift(bodies: RandomizationConfig, name: str, offset: float, unit: str, lowest: float | None = None) -> Variation:
    moved = [value + offset for value in getattr(bodies, name)]
    if lowest is not None:
        moved = [max(value, lowest) for value in moved]
    return Variation(name, f"{offset:+g}{unit}", (_range(f"randomization.{name}", moved),))


def _range(key: str, bounds: Sequence[float]) -> str:
    return f"{key}=[{bounds[0]:.6g},{bounds[1]:.6g}]"


@dataclass(frozen=True)
class Cell:
    """A variation as it is played: the overrides of the saved task, the device (the CPU for engine=native), serves a
    row and worlds, and the time that it takes in serves of the fast engine. ``wait``: s that robots stand ready before
    their first ball, which alone is played then; None for a row of serves.

    ``key`` identifies all settings that its numbers depend on: cells with the same key are played once, and found again
    in a sweep's file.
    """

    variation: Variation
    overrides: tuple[str, ...]
    device: str
    serves: int
    worlds: int
    cost: float
    key: str
    wait: float | None = None


def engine_name(task: TrainConfig, device_type: str) -> str:
    """The engine that ``auto`` means on a device."""
    if task.engine.name != "auto":
        return task.engine.name
    return "mjwarp" if device_type == "cuda" else "native"


def plan_cell(
    variation: Variation, config: EvaluateConfig, policy: TaskPolicy, overrides: Sequence[str], program: Any
) -> Cell:
    """How ``variation`` of the task of ``policy`` with ``overrides`` is played.

    An engine that is slow on the device plays ``sweep_serves_slow``. ``program``: versions of what computes it.
    """
    device = resolve_device(config.device)
    changed = (*overrides, *variation.overrides)
    task = override_task(policy.config, changed)
    task.engine.name = engine_name(task, device.type)
    if task.engine.name == "native" and device.type == "cuda":
        device, task.engine.graph = torch.device("cpu"), "auto"  # no CUDA graphs on a CPU
        changed = (*changed, "engine.graph=auto")
    slow = task.engine.name == "mjwarp" and device.type == "cpu"
    serves = config.sweep_serves_slow if slow else config.sweep_serves
    worlds = config.worlds_for(serves)
    played = worlds * (config.warmup_serves + math.ceil(serves / worlds)) * len(config.sweep_rows)
    depends = [policy.source, dict(policy.counters), config.seed, config.warmup_serves, config.sweep_rows, serves]
    key = _key(*depends, worlds, str(device), program, to_dict(task))
    return Cell(variation, changed, str(device), serves, worlds, played * (SLOWNESS if slow else 1.0), key)


def plan_first_balls(config: EvaluateConfig, policy: TaskPolicy, overrides: Sequence[str], program: Any) -> list[Cell]:
    """A cell for each time of ``first_ball`` on the unchanged task, with the serves of ``sweep_rows``."""
    given = plan_cell(Variation("first ball", "", ()), config, policy, overrides, program)
    longest, worlds = override_task(policy.config, overrides).serve.max_duration, config.first_ball_worlds
    return [
        replace(
            given,
            variation=Variation("first ball", f"after {wait:g} s", ()),
            serves=worlds,
            worlds=worlds,
            cost=worlds * len(config.sweep_rows) * (1.0 + wait / longest),
            key=_key(given.key, wait, worlds, config.first_ball_kind),
            wait=wait,
        )
        for wait in config.first_ball
    ]


def _key(*depends: Any) -> str:
    return hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()[:16]


def finished_cells(folder: Path, cells: Sequence[Cell]) -> Tables:
    """Rows of those ``cells`` that a sweep in ``folder`` has finished, by key; empty without a sweep.

    Errors: :class:`EvaluationError` for an unreadable ``sweep.json``, or one that holds cells of another sweep.
    """
    file = folder / JSON
    if not file.exists():
        return {}
    try:
        tables = {cell["key"]: cell["rows"] for cell in json.loads(file.read_text(encoding="utf-8"))["cells"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EvaluationError(f"{file} is no file of a sweep ({error!r}): give another out=") from error
    if not set(tables) <= {cell.key for cell in cells}:
        raise EvaluationError(
            f"{file} is of a sweep with another policy, settings or version of pace: give another out="
        )
    return tables


def cells_to_play(cells: Sequence[Cell], finished: Tables) -> list[Cell]:
    """Those ``cells`` that are not ``finished``, one of each key, the slow ones last."""
    first: dict[str, Cell] = {}
    for cell in cells:
        if cell.key not in finished:
            first.setdefault(cell.key, cell)
    return sorted(first.values(), key=lambda cell: cell.cost)


def write_sweep(folder: Path, cells: Sequence[Cell], tables: Tables, context: Mapping[str, Any]) -> list[Path]:
    """``sweep.json`` and the heat map in ``folder``, of those ``cells`` that ``tables`` has the rows of.

    An interruption leaves the previous file intact.
    """
    done = [cell for cell in cells if cell.key in tables]
    entries = [_entry(cell, tables[cell.key]) for cell in done]
    files = [folder / name for name in FILES]
    folder.mkdir(parents=True, exist_ok=True)
    write_json(files[0], {"cells": entries, **context})
    figure = heat_map(
        [(cell.variation.kind, cell.variation.label) for cell in done],
        [tables[cell.key] for cell in done],
        f"{context['policy']}: one change at a time; engine {context['engine']} unless changed",
    )
    write_figure(files[1], figure, dpi=DPI)
    return files


def _entry(cell: Cell, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    own = cell.variation
    change = {"kind": own.kind, "value": own.value, "overrides": list(own.overrides)}
    return {**change, "num_worlds": cell.worlds, "key": cell.key, "rows": list(rows)}
