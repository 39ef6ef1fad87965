"""``python -m pace.predictor``: train the predictor alone; the same as ``pace predictor``."""

from __future__ import annotations

import sys

from pace.command import run_command
from pace.command.run import Work


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command("predictor", load)


def load() -> Work:
    """What the command does, and the errors that it may end with."""
    from pace.rl.predictor_run import train_predictor

    return train_predictor, ()


if __name__ == "__main__":
    sys.exit(main())
