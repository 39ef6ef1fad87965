"""``python -m pace.studies STUDY``: the measurements of the documentation; the same as ``pace studies``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "studies")

if __name__ == "__main__":
    sys.exit(main())
