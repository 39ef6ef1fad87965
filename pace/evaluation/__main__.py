"""``python -m pace.evaluation RUN``: the paper's table of hits and returns; the same as ``pace evaluate``."""

from __future__ import annotations

import sys

from pace.command import run_command
from pace.command.run import Work


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command("evaluate", load)


def load() -> Work:
    """What the command does, and the errors that it may end with."""
    from pace.evaluation.evaluate import evaluate_from_config
    from pace.evaluation.serves import EvaluationError
    from pace.runs.checkpoint import CheckpointError

    return evaluate_from_config, (EvaluationError, CheckpointError)


if __name__ == "__main__":
    sys.exit(main())
