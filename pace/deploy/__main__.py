"""``python -m pace.deploy RUN``: a policy as one ONNX file for the robot; the same as ``pace export``."""

from __future__ import annotations

import sys

from pace.command import run_command
from pace.command.run import Work


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command("export", load)


def load() -> Work:
    """What the command does, and the errors that it may end with."""
    from pace.deploy.export import ExportError, export_from_config
    from pace.runs.checkpoint import CheckpointError

    return export_from_config, (ExportError, CheckpointError)


if __name__ == "__main__":
    sys.exit(main())
