"""Old command lines: ``python -m pace.rl.evaluate`` ends in one line that names the new one.

Python runs this file in place of a module of :data:`MOVED`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from types import ModuleType

#: Module that was a command -> the command of ``pace`` that it is now.
MOVED = {
    "pace.rl.evaluate": "evaluate",
    "pace.rl.play": "play",
    "pace.rl.export": "export",
    "pace.rl.ablate": "ablate",
    "pace.rl.keep": "keep",
    "pace.predictor.train": "predictor",
    "pace.sim.validate": "validate",
}


class MovedCommands(MetaPathFinder):
    """Finds this file for the names of :data:`MOVED`, which no other finder knows."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """See :class:`importlib.abc.MetaPathFinder`."""
        return spec_from_file_location(fullname, __file__) if fullname in MOVED else None


if __name__ == "__main__" and __spec__ is not None:
    print(f"error: python -m {__spec__.name} is now: pace {MOVED[__spec__.name]}", file=sys.stderr)
    sys.exit(2)
elif __name__ in MOVED:
    raise ImportError(f"{__name__} is the command pace {MOVED[__name__]} now; import from its room")
