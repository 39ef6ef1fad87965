"""``python -m pace.studies.ball``: the ball against independent solutions; the same as ``pace validate``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "validate")

if __name__ == "__main__":
    sys.exit(main())
