"""Memory and open files of a process, and the size of a folder, as a long run goes on (Linux)."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from pace.config.base import ConfigError
from pace.studies.common import COLOURS, Array

PROC = Path("/proc")
SETTLED = 0.1  # share of a run in which it allocates what it then keeps: libraries, rollout, statistics


def resident(pid: int) -> float:
    """Resident memory of a process, MiB. Errors: ``OSError`` if it has ended."""
    pages = int((PROC / str(pid) / "statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def open_files(pid: int) -> int:
    """Open files of a process. Errors: ``OSError`` if it has ended."""
    return len(os.listdir(PROC / str(pid) / "fd"))


def folder_size(folder: Path) -> float:
    """Bytes in all files of a folder, MiB; files that go meanwhile do not count."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(parent, name)).st_size
            except FileNotFoundError:
                continue
    return total / 2**20


def require_proc() -> None:
    """Errors: :class:`ConfigError` on a system that does not tell a process's memory."""
    if not (PROC / "self" / "statm").exists():
        raise ConfigError("this study reads /proc, which only Linux has")


@dataclass
class Watch:
    """Samples of a run, one each ``interval`` seconds at most, from its first progress on.

    Each has the progress (updates, serves), seconds, memory (MiB), open files, and the size of what it writes (MiB).
    """

    pid: int
    folder: Path | None = None
    interval: float = 1.0  # s
    rows: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    _started: float = field(default_factory=time.monotonic)

    def sample(self, progress: float) -> None:
        """Add a row if it is due. Errors: ``OSError`` if the process has ended."""
        now = time.monotonic() - self._started
        last, at, *_ = self.rows[-1] if self.rows else (0.0, -self.interval)
        if progress <= last or now - at < self.interval:
            return
        size = folder_size(self.folder) if self.folder else 0.0
        self.rows.append((progress, now, resident(self.pid), float(open_files(self.pid)), size))

    def columns(self) -> Array:
        """(5, M): the rows as columns."""
        return np.array(self.rows).T


def growth(progress: Array, memory: Array) -> tuple[float, float]:
    """Least-squares growth of ``memory`` (M,), and its largest value above that at the start; MiB, settled part alone.

    The first number is the growth from the settled part's start to the run's end.
    """
    settled = progress >= SETTLED * progress[-1]
    x, y = progress[settled], memory[settled]
    slope = float(np.polyfit(x, y, 1)[0])
    return slope * float(x[-1] - x[0]), float(y.max() - y[0])


def text(watch: Watch, what: str) -> str:
    """Memory, open files and time of a run, whose progress counts ``what``."""
    progress, seconds, memory, files, size = watch.columns()
    grown, most = growth(progress, memory)
    settled = progress >= SETTLED * progress[-1]
    lines = [
        f"{progress[-1]:,.0f} {what} in {seconds[-1] / 60:.1f} min",
        f"memory {memory[settled][0]:.0f} MiB after {progress[settled][0]:,.0f}, {memory[-1]:.0f} at the end; "
        f"trend {grown:+.1f} MiB over the rest, largest value {most:+.1f}",
        f"open files {files[settled].min():.0f} to {files[settled].max():.0f}",
    ]
    return "\n".join(lines) + (f"\nfolder {size[-1]:.1f} MiB at the end" if watch.folder else "")


def draw(watch: Watch, what: str, figure: Figure) -> None:
    """Memory, open files and size of the folder against the progress."""
    progress, _, memory, files, size = watch.columns()
    panels = [("memory, MiB", memory), ("open files", files)]
    panels += [("run folder, MiB", size)] if watch.folder else []
    for axes, (label, values), colour in zip(figure.subplots(1, len(panels)), panels, COLOURS, strict=False):
        axes.plot(progress, values, color=colour, lw=1)
        axes.set(xlabel=what, ylabel=label)
        axes.set_ylim(bottom=0, top=1.15 * values.max())
        axes.grid(alpha=0.3)
