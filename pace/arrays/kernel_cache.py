"""Warp's start: its folder of compiled kernels, for users without a home that can be written, and its words."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import warp as wp

from pace.config.base import ConfigError
from pace.devices import has_driver

#: Of Warp's native code, on a machine without a GPU: nobody can act on it.
NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
VARIABLE = "WARP_CACHE_PATH"  # of Warp's: another folder


def init_warp() -> None:
    """``wp.init`` with a folder of kernels that can be written: Warp's own, else one in the temporary folder.

    Errors: :class:`ConfigError` if there is none, or if the environment names one that cannot be written.
    """
    try:
        _init()
        folder = str(wp.config.kernel_cache_dir)
        if os.access(folder, os.W_OK):
            return
        reason = f"{folder} cannot be written"
    except OSError as error:
        reason = f"{error.filename} cannot be made: {error.strerror}"
    if VARIABLE in os.environ:
        raise ConfigError(f"{VARIABLE}: {reason}")
    own = private_folder(reason)
    print(f"compiled kernels go to {own}: {reason}, and {VARIABLE} names no other folder", file=sys.stderr)
    wp.config.kernel_cache_dir = str(own)
    _init()


def _init() -> None:
    if has_driver() or not hasattr(os, "memfd_create"):  # only Linux has it
        wp.init()
        return
    with without_line(NO_DRIVER):
        wp.init()


@contextmanager
def without_line(text: bytes) -> Iterator[None]:
    """What native code prints to stderr meanwhile comes afterwards, without the lines that contain ``text``."""
    try:
        saved = os.dup(2)
    except OSError:  # there is no stderr
        yield
        return
    with open(os.memfd_create("stderr"), "r+b") as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            caught.seek(0)
            os.write(2, b"".join(line for line in caught if text not in line))


def private_folder(reason: str) -> Path:
    """A folder of this user alone in the temporary one: kernels are programs, and are not taken from anybody.

    Errors: :class:`ConfigError` if it cannot be made, or is somebody else's.
    """
    cure = f"{reason}; {VARIABLE} names another folder for compiled kernels"
    if not hasattr(os, "getuid"):
        raise ConfigError(cure)
    try:
        folder = Path(tempfile.gettempdir()) / f"pace_kernels_{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise ConfigError(f"{cure} ({error.strerror or error})") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise ConfigError(f"{cure} ({folder} is not this user's alone)")
    return folder
