"""The contract beside an exported policy: what the robot's driver must supply and may expect, as ``policy.json``.

:mod:`pace.deploy.player` reads it, without this package.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pace.deploy.player import CONTRACT, SHARED
from pace.runs.files import write_whole

STEPS = 16  # of the examples, from a state of zeros on
DIGITS = 6  # of the examples' numbers

Frame = Mapping[str, NDArray[np.float32]]


def write_contract(
    file: Path, metadata: Mapping[str, Any], session: Any, frames: Sequence[Frame], tolerance: float
) -> Path:
    """Write the contract of ``file`` beside it, and return its path.

    Args: metadata: of the file; session: the file in onnxruntime; frames: readings (1, size) of consecutive control
    steps; tolerance: rad, by which a target of the examples may differ. Errors: ``OSError``.
    """
    content = {
        "contract": CONTRACT,
        "file": file.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        **{key: metadata[key] for key in SHARED},
        "examples": {"tolerance": tolerance, **play(session, frames)},
    }
    beside = file.with_suffix(".json")
    write_whole(beside, f"{_in_lines(content)}\n")
    return beside


def play(session: Any, frames: Sequence[Frame]) -> dict[str, Any]:
    """The frames, rounded, and the targets that the file gives for them from a state of zeros on."""
    names = [port.name for port in session.get_outputs()]
    size = next(port.shape[1] for port in session.get_inputs() if port.name == "state")
    state = np.zeros((1, size), dtype=np.float32)
    readings: dict[str, list[Any]] = {name: [] for name in frames[0] if name != "state"}
    targets = []
    for frame in frames:
        rounded = {name: np.round(frame[name], DIGITS).astype(np.float32) for name in readings}
        outputs = dict(zip(names, session.run(None, rounded | {"state": state}), strict=True))
        state = outputs["state_next"]
        targets.append(_plain(outputs["joint_target"]))
        for name, value in rounded.items():
            readings[name].append(_plain(value))
    return {"readings": readings, "joint_target": targets}


def _plain(row: NDArray[np.float32]) -> list[float]:
    return [round(float(value), DIGITS) for value in row[0]]


def _in_lines(content: Mapping[str, Any]) -> str:
    """JSON with a line for each entry of the two outer levels."""

    def entries(part: Mapping[str, Any], indent: str) -> str:
        return ",\n".join(f"{indent}{json.dumps(key)}: {value}" for key, value in part.items())

    def value(part: Any) -> str:
        inner = isinstance(part, dict) and part
        return (
            "{\n" + entries({k: json.dumps(v) for k, v in part.items()}, "  ") + "\n }" if inner else json.dumps(part)
        )

    return "{\n" + entries({key: value(part) for key, part in content.items()}, " ") + "\n}"
