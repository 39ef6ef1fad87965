"""``python -m pace.viewer.watch RUN``: the newest policy of a run that trains; the same as ``pace watch``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "watch")

if __name__ == "__main__":
    sys.exit(main())
