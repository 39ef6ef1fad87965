"""``python -m pace.predictor``: train the predictor alone; the same as ``pace predictor``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "predictor")

if __name__ == "__main__":
    sys.exit(main())
