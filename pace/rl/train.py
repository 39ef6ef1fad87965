"""``python -m pace.rl.train``: train a policy and its predictor; the same as ``pace train``."""

from __future__ import annotations

import sys

from pace.command import run_command
from pace.command.run import Work


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command("train", load)


def load() -> Work:
    """What the command does, and the errors that it may end with."""
    from pace.distributed import ProcessGroupError
    from pace.rl.rollout import RolloutError
    from pace.rl.session import train_from_config
    from pace.runs.checkpoint import CheckpointError

    return train_from_config, (ProcessGroupError, RolloutError, CheckpointError)


if __name__ == "__main__":
    sys.exit(main())
