"""``python -m pace.viewer RUN``: watch a policy, on a live page or in a film; the same as ``pace play``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "play")

if __name__ == "__main__":
    sys.exit(main())
