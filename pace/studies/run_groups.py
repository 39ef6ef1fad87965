"""Runs that are compared: seeds of one configuration are one group, and the keys in which groups differ are told."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from pace.config.training import RESUME_KEYS
from pace.rl.policies import locate
from pace.runs.checkpoint import read_meta
from pace.runs.checkpoint_folders import FOLDER, CheckpointError, find_checkpoint
from pace.runs.queue import flat
from pace.runs.run_folder import CONFIG, METRICS

#: Keys in which runs of one configuration may differ. The planned length is none: exploration falls over it.
FREE = {"seed", *RESUME_KEYS} - {"samples", "minutes"}
SEED = re.compile(r"[_-]?seed[_-]?\d+|_\d+$")  # in the name of a run, or the number of a second one
DATE = re.compile(r"^\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_")
LISTED = 4  # keys in which a group differs; more are counted
SHORT = 32  # characters of a value; of a longer one the key alone is told


@dataclass(frozen=True)
class Given:
    """A run that was named: its metrics, if it has any, and its configuration by dotted keys, empty for a CSV."""

    path: Path
    name: str
    metrics: Path | None
    config: Mapping[str, Any]


def read_run(path: str) -> Given:
    """The run folder, checkpoint, published policy or CSV at ``path``.

    Errors: :class:`CheckpointError` for anything else, and for a configuration that cannot be read.
    """
    if path.endswith(".csv") and Path(path).is_file():
        return Given(Path(path), Path(path).stem, Path(path), {})
    folder = locate(path)
    folder = folder.parent if folder.is_file() else folder
    run = folder.parent.parent if folder.parent.name == FOLDER else folder
    metrics = run / METRICS
    name = DATE.sub("", run.resolve().name)
    return Given(folder, name, metrics if metrics.is_file() else None, flat(_config_of(folder, run)))


def _config_of(folder: Path, run: Path) -> dict[str, Any]:
    """Of a run that has no checkpoint yet, the one that it was started with."""
    if folder == run and (run / CONFIG).is_file():
        try:
            loaded = yaml.safe_load((run / CONFIG).read_text(encoding="utf-8"))
        except (yaml.YAMLError, OSError, ValueError) as error:
            raise CheckpointError(f"{run / CONFIG} cannot be read: {' '.join(str(error).split())}") from error
        if isinstance(loaded, dict):
            return {str(key): value for key, value in loaded.items()}
        raise CheckpointError(f"{run / CONFIG} is no configuration")
    return read_meta(find_checkpoint(folder))["config"]


def group_runs(runs: Sequence[Given]) -> dict[str, list[Given]]:
    """Runs with metrics by the name of their configuration, in the order given.

    CSVs, which have none, are one configuration if their names differ in the seed alone.
    """
    groups: list[tuple[object, list[Given]]] = []
    for run in runs:
        if run.metrics is None:
            continue
        key = settings(run) or SEED.sub("", run.name)
        same = next((members for other, members in groups if other == key), None)
        if same is None:
            groups.append((key, [run]))
        else:
            same.append(run)
    named: dict[str, list[Given]] = {}
    for _, members in groups:
        name = short = SEED.sub("", members[0].name) or members[0].name
        number = 1
        while name in named:
            number += 1
            name = f"{short} ({number})"
        named[name] = members
    return named


def settings(run: Given) -> dict[str, Any]:
    """The configuration of a run without its seed, limits and folders."""
    return {key: value for key, value in run.config.items() if key.split(".")[0] not in FREE}


def differences(groups: Mapping[str, Sequence[Given]]) -> dict[str, str]:
    """Of each group, the values of the keys in which groups differ, as overrides; empty for a CSV."""
    found = {name: settings(members[0]) for name, members in groups.items()}
    with_config = [config for config in found.values() if config]
    keys = sorted({key for config in with_config for key in config})
    differ = [key for key in keys if any(config.get(key) != with_config[0].get(key) for config in with_config[1:])]
    return {name: _listed(config, differ) if config else "" for name, config in found.items()}


def _listed(config: Mapping[str, Any], keys: Sequence[str]) -> str:
    own = [f"{key}={config[key]}" if len(str(config[key])) <= SHORT else key for key in keys if key in config]
    rest = f", and {len(own) - LISTED} more" if len(own) > LISTED else ""
    return ", ".join(own[:LISTED]) + rest
