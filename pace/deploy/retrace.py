"""``python -m pace.deploy.retrace POLICY LOG``: a log through the exported file; the same as ``pace retrace``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "retrace")

if __name__ == "__main__":
    sys.exit(main())
