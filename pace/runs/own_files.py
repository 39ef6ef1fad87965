"""Files that the commands write into a folder of the user's: no other file of these names is replaced.

A hidden list in the folder names what was written there. Of before there was one, a file counts as written by a command
if its content says so.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from pace.config.base import ConfigError
from pace.runs.files import reason, write_whole

LIST = ".pace_files"
#: Keys of which each JSON of a command has one: evaluation, comparison; sweep; bench.
JSON_KEYS = {"versions", "cells", "packages"}
CSV_HEAD = b"update,samples,"  # of the metrics of an ablation's runs
ONNX_KEYS = (b"joint_names", b"nominal_pose", b"action_scale")  # metadata of an exported policy


def claim(folder: Path, names: Sequence[str]) -> None:
    """Note that a command is going to write the files ``names`` in ``folder``.

    Errors: :class:`ConfigError` if one is there that no command of pace has written, or the list cannot be read or
    written.
    """
    try:
        listed = _read(folder / LIST)
        taken = [name for name in names if (folder / name).exists() and name not in listed]
        if taken and not _of_before(folder, names):
            raise ConfigError(
                f"{folder / taken[0]} is no file that pace has written there, and is not replaced: give "
                "another name or folder, or move it away"
            )
        if not listed.issuperset(names):
            write_whole(folder / LIST, "".join(f"{name}\n" for name in sorted({*listed, *names})))
    except OSError as error:
        raise ConfigError(f"{folder / LIST} cannot be used: {reason(error)}") from error


def _read(file: Path) -> set[str]:
    return set(file.read_text(encoding="utf-8", errors="replace").splitlines()) if file.exists() else set()


def _of_before(folder: Path, names: Sequence[str]) -> bool:
    """Whether one of the files tells by its content that a command has written them."""
    return any(_tells(folder / name) for name in names if (folder / name).is_file())


def _tells(file: Path) -> bool:
    content = file.read_bytes()
    if file.suffix == ".onnx":
        return all(key in content for key in ONNX_KEYS)
    if file.suffix != ".json":
        return file.suffix == ".csv" and content.startswith(CSV_HEAD)
    try:
        found = json.loads(content)
    except ValueError:  # also of text that is none
        return False
    return isinstance(found, dict) and not JSON_KEYS.isdisjoint(found)
