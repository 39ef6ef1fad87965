"""Checkpoints: a folder of safetensors and JSON, so that loading one runs no code.

``checkpoint.json`` holds the format number, the configuration, the counters and the place of every tensor;
``weights.safetensors`` the networks and normalisers; ``training.safetensors`` the other state of an exact resume
(optimisers, random states, the worlds). A folder is written under a temporary name and renamed when complete.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from pace.config.upgrade import FORMAT, upgrade_config, upgrade_state
from pace.runs.checkpoint_folders import META, TRAINING, WEIGHTS, CheckpointError, find_checkpoint, holds_nothing_else
from pace.runs.files import reason

TENSOR_MARK = "__tensor__"
PROCESSES = "processes"  # part of the training state: the worlds and random numbers of each process of the run


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
            name = str(value[TENSOR_MARK])
            if name not in tensors:
                raise CheckpointError(f"{source}: the tensor {name} is missing")
            return tensors[name]
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
    (folder / META).write_text(json.dumps(meta, indent=1), encoding="utf-8")
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


def load_checkpoint(path: str | Path, weights_only: bool = False) -> Checkpoint:
    """Read the checkpoint that ``path`` means (see :func:`find_checkpoint`), onto the CPU.

    Errors: :class:`CheckpointError` for a missing or truncated file, another format number or a missing tensor.
    """
    folder = find_checkpoint(path)
    meta = read_meta(folder)
    weights = _restore(meta["weights"], folder / WEIGHTS)
    for part, tensors in weights.items():
        if not isinstance(tensors, dict) or not all(isinstance(tensor, Tensor) for tensor in tensors.values()):
            raise CheckpointError(f"{folder / META}: the weights of {part} are no tensors by name")
    training = None
    if meta["training"] is not None and not weights_only:
        training = _restore(meta["training"], folder / TRAINING)
        with _of_another_form(folder / META, "training state"):
            training = upgrade_state(training, meta["format"])
    return Checkpoint(meta["config"], meta["counters"], weights, training, folder)


def _restore(described: Any, file: Path) -> Any:
    """What ``checkpoint.json`` describes, with the tensors of ``file``."""
    try:
        return restore_tensors(described, _read_tensors(file), file)
    except RecursionError as error:
        raise CheckpointError(f"{file.parent / META} cannot be read: {error}") from error


@contextmanager
def _of_another_form(file: Path, part: str) -> Iterator[None]:
    """Errors: :class:`CheckpointError` for content that no version of pace has written, while that is upgraded."""
    try:
        yield
    except (AttributeError, KeyError, IndexError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{file}: the {part} is of no version of pace ({type(error).__name__}: {error})"
        ) from error


def read_meta(folder: Path) -> dict[str, Any]:
    """The content of ``checkpoint.json``: config, counters and places of the tensors, which are not read.

    The configuration is that of the current format, ``format`` that of the file.

    Errors: :class:`CheckpointError` for a file that cannot be read, has another format number or lacks a part.
    """
    file = folder / META
    try:
        meta = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # no text, no JSON, numbers or depths that make no sense
        raise CheckpointError(f"{file} cannot be read: {error}") from error
    if not isinstance(meta, dict) or "format" not in meta:
        raise CheckpointError(f"{file} is not a checkpoint: it has no format number")
    if type(meta["format"]) is not int or meta["format"] not in range(1, FORMAT + 1):
        raise CheckpointError(f"{file} has format {meta['format']}, this version of pace reads format 1 to {FORMAT}")
    missing = [key for key in ("config", "counters", "weights", "training") if key not in meta]
    if missing:
        raise CheckpointError(f"{file} lacks {', '.join(missing)}")
    _check_form(meta, file)
    with _of_another_form(file, "configuration"):
        meta["config"] = upgrade_config(meta["config"], meta["format"])
    return meta


def _check_form(meta: dict[str, Any], file: Path) -> None:
    """Errors: :class:`CheckpointError` for parts of another kind than those that are written."""
    for part in ("config", "counters", "weights"):
        if not isinstance(meta[part], dict):
            raise CheckpointError(f"{file}: {part} is no table: is it of another version of pace?")
    if not isinstance(meta["training"], dict | None):
        raise CheckpointError(f"{file}: training is no table")
    for name, count in meta["counters"].items():
        if isinstance(count, bool) or not isinstance(count, int | float) or not 0 <= count < 1e18:
            raise CheckpointError(f"{file}: counters.{name} is {count!r}")


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


#: Keys of where and how a run was made, not of what it learned: a published policy has their defaults.
RUN_KEYS: dict[str, Any] = {
    "device": "auto", "processes": 0, "out": None, "resume": None, "init_from": None, "predictor_from": None
}  # fmt: skip


def export_weights(path: str | Path, folder: str | Path, training: bool = False) -> Path:
    """Copy a checkpoint's weights and configuration, for ``pretrained/``; with ``training`` also what the algorithm and
    the predictor's regression resume from, but not the worlds, which then start from scratch.

    Folders, threads and CUDA graphs of the training machine are left out of the configuration.

    Errors: :class:`CheckpointError` if there is no such state.
    """
    checkpoint = load_checkpoint(path, weights_only=not training)
    if training and checkpoint.training is None:
        raise CheckpointError(f"{checkpoint.path} holds weights only: its training cannot be resumed")
    state = {**checkpoint.training, PROCESSES: []} if checkpoint.training is not None else None
    kept = checkpoint.weights if training else _all_single(checkpoint.weights)
    config = checkpoint.config | {key: value for key, value in RUN_KEYS.items() if key in checkpoint.config}
    if "engine" in config:
        config["engine"] = config["engine"] | {"name": "auto", "threads": 0, "graph": "auto"}
    return save_checkpoint(Path(folder), Checkpoint(config, checkpoint.counters, kept, state))


def _all_single(weights: dict[str, dict[str, Tensor]]) -> dict[str, dict[str, Tensor]]:
    return {part: {name: _single(tensor) for name, tensor in tensors.items()} for part, tensors in weights.items()}


def _single(tensor: Tensor) -> Tensor:
    """Float32 of a float64 tensor; others unchanged."""
    return tensor.float() if tensor.dtype == torch.float64 else tensor
