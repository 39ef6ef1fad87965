"""The command line: table of the commands, their help, and one-line errors for wrong input instead of a traceback.

The common code of all commands belongs here, not the work of one command. Imports ``config``, and no torch:
``--help`` and errors of wrong input appear at once.
"""

import sys
from types import TracebackType


def _quiet(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Ctrl-C in the first second, while modules are imported, is one line; other errors are shown as always."""
    if issubclass(kind, KeyboardInterrupt):
        print("error: interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


if sys.excepthook is sys.__excepthook__:
    sys.excepthook = _quiet

from pace.command.arguments import quote  # noqa: E402
from pace.command.run import Terminated, run_command  # noqa: E402

__all__ = ["Terminated", "quote", "run_command"]
