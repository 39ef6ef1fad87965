"""``pace COMMAND``, and ``python -m pace COMMAND``: the same as ``python -m`` and the command's module.

Without a command it lists them.
"""

from __future__ import annotations

import runpy
import sys

from pace.command.help import overview
from pace.command.run import EXIT_USAGE, complain, show
from pace.command.table import COMMANDS
from pace.config.base import meant


def main() -> int:
    """Entry point; returns the exit status."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("-h", "--help", "help"):
        return show(overview())
    if name not in COMMANDS:
        return complain(f"there is no command '{name}'{meant(name, COMMANDS)} ({', '.join(COMMANDS)})", EXIT_USAGE)
    sys.argv[:] = [f"pace {name}", *sys.argv[2:]]
    runpy.run_module(COMMANDS[name].module, run_name="__main__", alter_sys=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
