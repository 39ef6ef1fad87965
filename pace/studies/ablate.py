"""``python -m pace.studies.ablate``: the effect of each part of the recipe; the same as ``pace ablate``."""

from __future__ import annotations

import sys

from pace.command import run_command
from pace.command.run import Work


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command("ablate", load)


def load() -> Work:
    """What the command does, and the errors that it may end with."""
    from pace.runs.checkpoint import CheckpointError
    from pace.studies.ablation import AblationError, ablate_from_config

    return ablate_from_config, (CheckpointError, AblationError)


if __name__ == "__main__":
    sys.exit(main())
