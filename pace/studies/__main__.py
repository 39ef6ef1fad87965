"""``python -m pace.studies STUDY``: the measurements of the documentation; the same as ``pace studies``."""

from __future__ import annotations

import sys

from pace.command import run_command
from pace.command.run import Work


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command("studies", load)


def load() -> Work:
    """What the command does, and the errors that it may end with."""
    from pace.runs.checkpoint import CheckpointError
    from pace.studies.catalogue import study_from_config

    return study_from_config, (CheckpointError,)


if __name__ == "__main__":
    sys.exit(main())
