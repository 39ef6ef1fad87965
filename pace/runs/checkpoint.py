"""Checkpoints: a folder of safetensors and JSON, so that loading one runs no code.

``checkpoint.json`` holds the format number, the configuration, the counters and the place of every tensor;
``weights.safetensors`` the networks and normalisers; ``training.safetensors`` the other state of an exact resume
(optimisers, random states, the worlds). A folder is written under a temporary name and renamed when complete.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from pace.config.upgrade import FORMAT, upgrade_config, upgrade_state
from pace.runs.files import reason

META, WEIGHTS, TRAINING = "checkpoint.json", "weights.safetensors", "training.safetensors"
FOLDER = "checkpoints"
FILES = (META, WEIGHTS, TRAINING)
NAME = re.compile(r"update_(\d{8,})")  # of the folders that a run writes; others beside them are the user's
LAST_GOOD = "last_good"  # folder in a run: the weights before an update that failed
LEFTOVER = re.compile(rf"\.(update_\d{{8,}}|{LAST_GOOD})\.\d+\.(tmp|old)")  # of a kill while a checkpoint was written
TENSOR_MARK = "__tensor__"


class CheckpointError(RuntimeError):
    """A checkpoint that cannot be found, read or used; the message names the file and the reason."""


@dataclass
class Checkpoint:
    """One checkpoint in memory: ``weights`` by part (agent, predictor); ``training``, None if it has weights only."""

    config: dict[str, Any]
    counters: dict[str, float]
    weights: dict[str, dict[str, Tensor]]
    training: dict[str, Any] | None
    path: Path | None = None


def flatten_tensors(value: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    """A JSON copy of nested dictionaries and lists in which every tensor is a reference into ``tensors``."""
    if isinstance(value, Tensor):
        tensors[name] = value.detach().cpu().contiguous().clone()
        return {TENSOR_MARK: name}
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"state {name or 'root'} has the key {key!r}; only strings can be saved")
        return {key: flatten_tensors(item, f"{name}.{key}" if name else key, tensors) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [flatten_tensors(item, f"{name}.{index}", tensors) for index, item in enumerate(value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"state {name} is a {type(value).__name__}, which a checkpoint cannot hold")


def restore_tensors(value: Any, tensors: Mapping[str, Tensor], source: Path) -> Any:
    """Inverse of :func:`flatten_tensors` (tuples come back as lists)."""
    if isinstance(value, dict):
        if TENSOR_MARK in value:
            if value[TENSOR_MARK] not in tensors:
                raise CheckpointError(f"{source}: the tensor {value[TENSOR_MARK]} is missing")
            return tensors[value[TENSOR_MARK]]
        return {key: restore_tensors(item, tensors, source) for key, item in value.items()}
    if isinstance(value, list):
        return [restore_tensors(item, tensors, source) for item in value]
    return value


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> Path:
    """Write ``checkpoint`` as ``folder``, whole or not at all; an existing checkpoint of that name is replaced.

    Errors: :class:`CheckpointError` for a disk that is full or cannot be written; what was there stays.
    """
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir(parents=True)
        _write(temporary, checkpoint)
        _replace(folder, temporary)
    except (OSError, SafetensorError) as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise CheckpointError(f"{folder} cannot be written: {reason(error)}") from error
    return folder


def _write(folder: Path, checkpoint: Checkpoint) -> None:
    """Write the files of ``checkpoint`` into a new folder, to the disk."""
    weights: dict[str, Tensor] = {}
    meta: dict[str, Any] = {
        "format": FORMAT,
        "counters": checkpoint.counters,
        "weights": flatten_tensors(checkpoint.weights, "", weights),
        "training": None,
        "config": checkpoint.config,
    }
    if checkpoint.training is not None:
        training: dict[str, Tensor] = {}
        meta["training"] = flatten_tensors(checkpoint.training, "", training)
        save_file(training, folder / TRAINING)
    save_file(weights, folder / WEIGHTS)
    (folder / META).write_text(json.dumps(meta, indent=1))
    readers = (folder / META).stat().st_mode & 0o777  # safetensors closes its files to everybody else
    for file in folder.iterdir():
        file.chmod(readers)
    for file in (*folder.iterdir(), folder):
        _sync(file)  # before the rename makes them the newest checkpoint


def _replace(folder: Path, fresh: Path) -> None:
    """Give ``fresh`` the name ``folder``. After a kill in between, :func:`clear_leftovers` puts back what was there."""
    old = fresh.with_suffix(".old")
    if folder.exists():
        folder.rename(old)
    try:
        fresh.rename(folder)
    except OSError:
        if old.exists():
            old.rename(folder)
        raise
    _sync(folder.parent)
    if old.exists() and holds_nothing_else(old):  # else it stays, with what a user has put there
        shutil.rmtree(old, ignore_errors=True)


def _sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def clear_leftovers(run: Path) -> None:
    """Remove what a kill has left of checkpoints that were being written. The caller owns the run."""
    for folder in (path for place in (run, run / FOLDER) for path in _entries(place)):
        left = LEFTOVER.fullmatch(folder.name)
        if left is None or folder.is_symlink() or not holds_nothing_else(folder):
            continue
        if left[2] == "old" and not folder.with_name(left[1]).exists():
            folder.rename(folder.with_name(left[1]))
        else:
            shutil.rmtree(folder)


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def holds_nothing_else(folder: Path) -> bool:
    """Whether a folder has the files of a checkpoint, or some of them, and nothing that a user has put there."""
    return folder.is_dir() and all(file.name in FILES for file in folder.iterdir())


def find_checkpoint(path: str | Path) -> Path:
    """Folder of the checkpoint that ``path`` means: a run folder (its newest), a checkpoint folder, or a file in one.

    Errors: :class:`CheckpointError` when there is none.
    """
    try:
        return _find(Path(path))
    except (OSError, ValueError) as error:  # no permission; a name that is too long, or has a zero byte
        raise CheckpointError(f"{path} cannot be read: {reason(error)}") from error


def _find(path: Path) -> Path:
    if path.is_file():
        path = path.parent
    if not path.exists():
        raise CheckpointError(f"{path} does not exist: give a run folder or a checkpoint")
    if (path / META).is_file():
        return path
    if (path / FOLDER).is_dir():
        found = list_checkpoints(path)
        if found:
            return found[-1]
        others = ", ".join(other.name for other in _entries(path / FOLDER) if (other / META).is_file())
        named = f"; {FOLDER}/ holds {others}: name one of them" if others else ""
        raise CheckpointError(f"{path} is a run folder without a checkpoint{named}")
    raise CheckpointError(f"{path} is neither a run folder nor a checkpoint: it has no {FOLDER}/ and no {META}")


def list_checkpoints(run: Path) -> list[Path]:
    """Complete checkpoints that a run has written, oldest first. Copies beside them, of other names, are the user's."""
    there = (folder for folder in _entries(run / FOLDER) if NAME.fullmatch(folder.name))
    return sorted((folder for folder in there if (folder / META).is_file()), key=update_of)


def update_of(checkpoint: Path) -> int:
    """The update at which a run has written ``checkpoint``, by its name."""
    name = NAME.fullmatch(checkpoint.name)
    assert name is not None  # of a run
    return int(name[1])


def load_checkpoint(path: str | Path, weights_only: bool = False) -> Checkpoint:
    """Read the checkpoint that ``path`` means (see :func:`find_checkpoint`), onto the CPU.

    Errors: :class:`CheckpointError` for a missing or truncated file, another format number or a missing tensor.
    """
    folder = find_checkpoint(path)
    meta = read_meta(folder)
    weights = restore_tensors(meta["weights"], _read_tensors(folder / WEIGHTS), folder / WEIGHTS)
    training = None
    if meta["training"] is not None and not weights_only:
        training = restore_tensors(meta["training"], _read_tensors(folder / TRAINING), folder / TRAINING)
        training = upgrade_state(training, meta["format"])
    return Checkpoint(meta["config"], meta["counters"], weights, training, folder)


def read_meta(folder: Path) -> dict[str, Any]:
    """The content of ``checkpoint.json``: config, counters and places of the tensors, which are not read.

    The configuration is that of the current format, ``format`` that of the file.

    Errors: :class:`CheckpointError` for a file that cannot be read, has another format number or lacks a part.
    """
    file = folder / META
    try:
        meta = json.loads(file.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise CheckpointError(f"{file} cannot be read: {error}") from error
    if not isinstance(meta, dict) or "format" not in meta:
        raise CheckpointError(f"{file} is not a checkpoint: it has no format number")
    if meta["format"] not in range(1, FORMAT + 1):
        raise CheckpointError(f"{file} has format {meta['format']}, this version of pace reads format 1 to {FORMAT}")
    missing = [key for key in ("config", "counters", "weights", "training") if key not in meta]
    if missing:
        raise CheckpointError(f"{file} lacks {', '.join(missing)}")
    if isinstance(meta["config"], dict):
        meta["config"] = upgrade_config(meta["config"], meta["format"])
    return meta


def _read_tensors(file: Path) -> dict[str, Tensor]:
    if not file.is_file():
        raise CheckpointError(f"{file} is missing")
    try:
        return load_file(file)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{file} is broken: {error}") from error


def load_weights(module: nn.Module, weights: Mapping[str, Tensor], source: str) -> None:
    """Load a module's ``state_dict`` strictly.

    Errors: :class:`CheckpointError` that names the first missing, reshaped or unknown tensor.
    """
    own = module.state_dict()
    for name, tensor in own.items():
        if name not in weights:
            raise CheckpointError(f"{source}: the tensor {name} is missing")
        if weights[name].shape != tensor.shape:
            shapes = f"{tuple(weights[name].shape)}, this configuration needs {tuple(tensor.shape)}"
            raise CheckpointError(f"{source}: the tensor {name} has the shape {shapes}")
    unknown = [name for name in weights if name not in own]
    if unknown:
        raise CheckpointError(f"{source}: the tensor {unknown[0]} is not of this network")
    module.load_state_dict(dict(weights))


def prune_checkpoints(run: Path, keep: int) -> None:
    """Delete all but the newest ``keep`` checkpoints of a run; not one that is a link, or to which files were added."""
    for folder in list_checkpoints(run)[:-keep]:
        if not folder.is_symlink() and holds_nothing_else(folder):
            shutil.rmtree(folder, ignore_errors=True)


#: Keys of where and how a run was made, not of what it learned: a published policy has their defaults.
RUN_KEYS: dict[str, Any] = {
    "device": "auto", "processes": 0, "out": None, "resume": None, "init_from": None, "predictor_from": None
}  # fmt: skip


def export_weights(path: str | Path, folder: str | Path) -> Path:
    """Copy a checkpoint's weights and configuration without its training state, for ``pretrained/``.

    Folders, threads and CUDA graphs of the training machine are left out of the configuration.
    """
    checkpoint = load_checkpoint(path, weights_only=True)
    slim = {part: {k: _single(v) for k, v in tensors.items()} for part, tensors in checkpoint.weights.items()}
    config = checkpoint.config | {key: value for key, value in RUN_KEYS.items() if key in checkpoint.config}
    if "engine" in config:
        config["engine"] = config["engine"] | {"name": "auto", "threads": 0, "graph": "auto"}
    return save_checkpoint(Path(folder), Checkpoint(config, checkpoint.counters, slim, None))


def _single(tensor: Tensor) -> Tensor:
    """Float32 of a float64 tensor; others unchanged."""
    return tensor.float() if tensor.dtype == torch.float64 else tensor
