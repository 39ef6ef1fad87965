"""``python -m pace.rl.warm``: compile the kernels of a training run; the same as ``pace warm``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "warm")

if __name__ == "__main__":
    sys.exit(main())
