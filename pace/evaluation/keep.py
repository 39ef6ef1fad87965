"""``python -m pace.evaluation.keep RUN FOLDER``: publish a policy; the same as ``pace keep``."""

from __future__ import annotations

import sys

from pace.command import run_command
from pace.command.run import Work


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command("keep", load)


def load() -> Work:
    """What the command does, and the errors that it may end with."""
    from pace.evaluation.publish import KeepError, keep_from_config
    from pace.runs.checkpoint import CheckpointError

    return keep_from_config, (KeepError, CheckpointError)


if __name__ == "__main__":
    sys.exit(main())
