"""What a policy survives: the table again under other balls, engines, sensors and bodies, one change at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pace.config import RandomizationConfig, SensingConfig, TrainConfig, VariationConfig, config_dir
from pace.rl.evaluation_figures import DPI, heat_map
from pace.rl.evaluation_report import write_json

JSON, MAP = "sweep.json", "sweep.png"
NOISE = tuple(name for name in SensingConfig.__dataclass_fields__ if name not in ("name", "mocap_delay"))


@dataclass(frozen=True)
class Variation:
    """One change of the task: which, its value, and the overrides that make it."""

    kind: str
    value: str
    overrides: tuple[str, ...]

    @property
    def label(self) -> str:
        """As it stands in the heat map."""
        return f"{self.kind.replace('_', ' ')} {self.value}".strip()


def ball_presets() -> list[str]:
    """Names of configs/ball/."""
    return sorted(file.stem for file in (config_dir() / "ball").glob("*.yaml") if not file.stem.startswith("_"))


def variations(task: TrainConfig, chosen: VariationConfig) -> list[Variation]:
    """The task as it is, then each change of ``chosen``; changes start from the values of ``task``."""
    sensing, bodies = task.sensing, task.randomization
    cells = [Variation("as given", "", ())]
    cells += [Variation("ball", name, (f"ball={name}",)) for name in chosen.ball or ball_presets()]
    cells += [Variation("engine", name, (f"engine={name}",)) for name in chosen.engine]
    for times in chosen.noise:
        louder = tuple(f"sensing.{name}={getattr(sensing, name) * times}" for name in NOISE)
        cells.append(Variation("noise", f"x {times:g}", louder))
    for extra in chosen.latency:
        later = _range("sensing.mocap_delay", [delay + extra for delay in sensing.mocap_delay])
        cells.append(Variation("latency", f"+ {1000 * extra:g} ms", (later,)))
    cells += [_shift(bodies, "friction", offset, "", lowest=0.05) for offset in chosen.friction]
    cells += [_shift(bodies, "trunk_mass", offset, " kg") for offset in chosen.trunk_mass]
    for times in chosen.gain:
        stronger = tuple(
            _range(f"randomization.{n}", [v * times for v in getattr(bodies, n)]) for n in ("kp_scale", "kd_scale")
        )
        cells.append(Variation("gain", f"x {times:g}", stronger))
    return cells


def _shift(bodies: RandomizationConfig, name: str, offset: float, unit: str, lowest: float | None = None) -> Variation:
    moved = [value + offset for value in getattr(bodies, name)]
    if lowest is not None:
        moved = [max(value, lowest) for value in moved]
    return Variation(name, f"{offset:+g}{unit}", (_range(f"randomization.{name}", moved),))


def _range(key: str, bounds: Sequence[float]) -> str:
    return f"{key}=[{bounds[0]:.6g},{bounds[1]:.6g}]"


def write_sweep(
    folder: Path, cells: Sequence[Variation], tables: Sequence[Sequence[dict[str, Any]]], context: dict[str, Any]
) -> list[Path]:
    """``sweep.json`` and the heat map in ``folder``; ``tables`` holds the summaries of the rows of each cell."""
    entries = [
        {"kind": cell.kind, "value": cell.value, "overrides": list(cell.overrides), "rows": list(rows)}
        for cell, rows in zip(cells, tables, strict=True)
    ]
    files = [folder / JSON, folder / MAP]
    write_json(files[0], {"cells": entries, **context})
    values = {name: [[row[name] for row in rows] for rows in tables] for name in ("hit", "success")}
    names = [row["serve"] for row in tables[0]]
    heat_map([cell.label for cell in cells], names, values).savefig(files[1], dpi=DPI)
    return files
