"""Files that survive a full disk, a kill and a deleted folder: written whole, or appended piece by piece."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LARGEST_WAITING = 64 * 2**20  # bytes that wait in memory for a disk to be written again


def say(text: str) -> None:
    """Print to stderr, above a progress bar if there is one. The log may lie on the disk that is full."""
    with suppress(OSError):
        tqdm.write(text, file=sys.stderr)


def tell(text: str) -> None:
    """Print to stdout at once. A log on a full disk, or a closed pipe, does not end a run."""
    with suppress(OSError):
        print(text, flush=True)


def reason(error: Exception) -> str:
    """Why an operation on a file failed, in a few words."""
    return (error.strerror if isinstance(error, OSError) else None) or " ".join(str(error).split())


def write_whole(file: Path, content: str | bytes) -> None:
    """Write ``file``, or leave what is there: the new content replaces it when it is on the disk.

    Text is UTF-8. Names of files in it that the locale cannot read are written byte by byte, as the disk has them.

    Errors: ``OSError``.
    """
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as handle:
            handle.write(content.encode(errors="surrogateescape") if isinstance(content, str) else content)
            handle.flush()
            os.fsync(handle.fileno())
        temporary.replace(file)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def write_figure(file: Path, figure: Figure, dpi: int, **options: Any) -> None:
    """:func:`write_whole` a figure of matplotlib, as a PNG. Errors: ``OSError``."""
    picture = BytesIO()
    figure.savefig(picture, dpi=dpi, format="png", **options)
    write_whole(file, picture.getvalue())


class AppendFile:
    """A file that grows by whole pieces. A piece that cannot be written waits in memory, and is tried with the next.

    A deleted file is made again. ``head`` makes the first piece of an empty file.
    """

    def __init__(self, path: Path, head: Callable[[], bytes] = bytes) -> None:
        self.path, self._head = path, head
        self._handle = -1
        self._waiting = b""
        self._told, self._lost = False, 0

    def add(self, piece: bytes) -> None:
        """Append ``piece``. Says so if that fails, and when it succeeds again."""
        if len(self._waiting) + len(piece) <= LARGEST_WAITING:
            self._waiting += piece
        else:
            self._lost += 1
        try:
            self._open()
            self._write()
        except OSError as error:
            if not self._told:
                say(f"warning: {self.path} cannot be written: {reason(error)}; what is to be written waits in memory")
            self._told = True
            return
        if self._told:
            lost = f"{self._lost} pieces of it are lost" if self._lost else "nothing of it is lost"
            say(f"{self.path} can be written again; {lost}")
        self._told, self._lost = False, 0

    def _open(self) -> None:
        """Open the file at its path, if what is open is not that."""
        try:
            there = self.path.stat()
        except FileNotFoundError:
            there = None
        if self._handle >= 0:
            own = os.fstat(self._handle)
            if there is not None and (own.st_ino, own.st_dev) == (there.st_ino, there.st_dev):
                return
            if there is None:
                say(f"warning: {self.path} was deleted: it is made again, with what comes from now on")
            self.close()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._handle = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)

    def _write(self) -> None:
        """Write all that waits, or nothing of it."""
        size, written = os.fstat(self._handle).st_size, 0
        piece = self._waiting if size else self._head() + self._waiting
        try:
            while written < len(piece):
                written += os.write(self._handle, piece[written:])
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._handle, size)
            raise
        self._waiting = b""

    def close(self) -> None:
        """Close the file, if it is open."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1
