"""Folders that the commands write, and their files in a folder of the user's: no other file of these names is replaced.

A hidden list in the folder names what was written there. Of before there was one, a file counts as written by a command
if its content says so.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from pace.config.base import ConfigError
from pace.runs.files import reason, write_whole

LIST = ".pace_files"
#: Keys of which each JSON of a command has one: evaluation, comparison; sweep; bench.
JSON_KEYS = {"versions", "cells", "packages"}
CSV_HEAD = b"update,samples,"  # of the metrics of an ablation's runs
ONNX_KEYS = (b"joint_names", b"nominal_pose", b"action_scale")  # metadata of an exported policy


def new_folder(name: str) -> Path:
    """Make ``runs/<date>_<name>``, with a number if that exists: of two commands in one second, each gets its own.

    Errors: ``OSError``.
    """
    base = Path("runs") / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}_{name}"
    base.parent.mkdir(parents=True, exist_ok=True)
    for number in count(1):
        folder = base if number == 1 else base.with_name(f"{base.name}_{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise AssertionError("count() does not end")


def make_out(out: str | None, name: str, files: Sequence[str] = ()) -> Path:
    """The folder that a command writes: ``out``, or a :func:`new_folder`. Made before the work begins.

    ``files`` are those that it will write there (:func:`claim`).

    Errors: :class:`ConfigError` for a folder that cannot be made or written, or holds other files of these names.
    """
    folder = Path(out) if out else Path("runs")
    try:
        if out:
            folder.mkdir(parents=True, exist_ok=True)
        else:
            folder = new_folder(name)
    except (OSError, ValueError) as error:  # ValueError: a path with a zero byte
        raise ConfigError(f"out={folder} cannot be made: {reason(error)}") from error
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ConfigError(f"out={folder} cannot be written: {reason(error)}") from error
    if files:
        claim(folder, files)
    return folder


@contextmanager
def started_out(out: str | None, name: str, files: Sequence[str]) -> Iterator[Path]:
    """:func:`make_out` for work that may fail before it writes: a new folder in which nothing was written is removed.

    Errors: those of :func:`make_out`.
    """
    new = out is None or not Path(out).exists()
    folder = make_out(out, name, files)
    try:
        yield folder
    except BaseException:
        if new:
            remove_unused(folder)
        raise


def remove_unused(folder: Path, hidden: Sequence[str] = ()) -> None:
    """Remove a folder that holds nothing but the list, and files of the names ``hidden``."""
    unused = {LIST, *hidden}
    with suppress(OSError):  # somebody else uses it
        if unused.issuperset(file.name for file in folder.iterdir()):
            for name in unused:
                (folder / name).unlink(missing_ok=True)
            folder.rmdir()


def claim(folder: Path, names: Sequence[str]) -> None:
    """Note that a command is going to write the files ``names`` in ``folder``.

    Errors: :class:`ConfigError` if one is there that no command of pace has written, or the list cannot be read or
    written.
    """
    with _usable(folder):
        if _others(folder, names) and not _of_before(folder, names):
            require_own(folder, names)
        note(folder, names)


def require_own(folder: Path, names: Sequence[str]) -> None:
    """Errors: :class:`ConfigError` if one of ``names`` is in ``folder``, and its list does not have it."""
    for file in _others(folder, names):
        raise ConfigError(
            f"{file} is no file that pace has written there, and is not replaced: give "
            "another name or folder, or move it away"
        )


def _others(folder: Path, names: Sequence[str]) -> list[Path]:
    """Files of ``names`` that are there, and are not in the list."""
    own, files = listed(folder), [folder / name for name in names]
    return [file for file in files if file.name not in own and (file.exists() or file.is_symlink())]


def listed(folder: Path) -> set[str]:
    """Names of what commands have written in ``folder``. Errors: :class:`ConfigError` if its list cannot be read."""
    file = folder / LIST
    with _usable(folder):
        return set(file.read_text(encoding="utf-8", errors="replace").splitlines()) if file.exists() else set()


def note(folder: Path, names: Sequence[str]) -> None:
    """Add ``names`` to the list of ``folder``. Errors: ``OSError``."""
    there = listed(folder)
    if not there.issuperset(names):
        write_whole(folder / LIST, "".join(f"{name}\n" for name in sorted({*there, *names})))


@contextmanager
def _usable(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigError(f"{folder / LIST} cannot be used: {reason(error)}") from error


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
