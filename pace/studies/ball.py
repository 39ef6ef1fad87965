"""``python -m pace.studies.ball``: the ball against independent solutions; the same as ``pace validate``."""

from __future__ import annotations

import sys

from pace.command import run_command
from pace.command.run import Work


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command("validate", load)


def load() -> Work:
    """What the command does, and the errors that it may end with."""
    from pace.studies.ball_figures import validate_from_config

    return validate_from_config, ()


if __name__ == "__main__":
    sys.exit(main())
