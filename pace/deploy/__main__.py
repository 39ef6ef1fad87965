"""``python -m pace.deploy RUN``: a policy as one ONNX file for the robot; the same as ``pace export``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "export")

if __name__ == "__main__":
    sys.exit(main())
