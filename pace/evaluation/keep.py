"""``python -m pace.evaluation.keep RUN FOLDER``: publish a policy; the same as ``pace keep``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "keep")

if __name__ == "__main__":
    sys.exit(main())
