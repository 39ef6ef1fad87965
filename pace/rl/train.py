"""``python -m pace.rl.train``: train a policy and its predictor; the same as ``pace train``."""

import sys
from functools import partial

from pace.command import run_command

main = partial(run_command, "train")

if __name__ == "__main__":
    sys.exit(main())
