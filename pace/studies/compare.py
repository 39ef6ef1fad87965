"""``python -m pace.studies.compare``: curves of runs, and two policies on the same serves; ``pace compare``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "compare")

if __name__ == "__main__":
    sys.exit(main())
