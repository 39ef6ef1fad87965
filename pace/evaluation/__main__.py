"""``python -m pace.evaluation RUN``: the paper's table of hits and returns; the same as ``pace evaluate``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "evaluate")

if __name__ == "__main__":
    sys.exit(main())
