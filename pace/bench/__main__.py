"""``python -m pace.bench``: measure this machine; the same as ``pace bench``."""

from __future__ import annotations

import sys

from pace.command import run_command
from pace.command.run import Work


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command("bench", load)


def load() -> Work:
    """What the command does, and the errors that it may end with."""
    from pace.bench.measure import bench_from_config
    from pace.bench.training import BenchError

    return bench_from_config, (BenchError,)


if __name__ == "__main__":
    sys.exit(main())
