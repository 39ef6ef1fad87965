"""``python -m pace.studies.ablate``: the effect of each part of the recipe; the same as ``pace ablate``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "ablate")

if __name__ == "__main__":
    sys.exit(main())
