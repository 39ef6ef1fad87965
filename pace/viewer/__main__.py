"""``python -m pace.viewer RUN``: watch a policy, on a live page or in a video; the same as ``pace play``."""

from __future__ import annotations

import sys

from pace.command import run_command
from pace.command.run import Work


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command("play", load)


def load() -> Work:
    """What the command does, and the errors that it may end with."""
    from pace.runs.checkpoint import CheckpointError
    from pace.sim.render import RenderError
    from pace.viewer.play import play_from_config
    from pace.viewer.web import PageError

    return play_from_config, (CheckpointError, RenderError, PageError)


if __name__ == "__main__":
    sys.exit(main())
