"""The command line: table of the commands, their help, and one-line errors for wrong input instead of a traceback.

The common code of all commands belongs here, not the work of one command. Imports ``config``, and no torch:
``--help`` and errors of wrong input appear at once.
"""

from pace.command.arguments import quote
from pace.command.run import Terminated, run_command

__all__ = ["Terminated", "quote", "run_command"]
