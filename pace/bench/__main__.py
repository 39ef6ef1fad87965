"""``python -m pace.bench``: measure this machine; the same as ``pace bench``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "bench")

if __name__ == "__main__":
    sys.exit(main())
