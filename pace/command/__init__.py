"""Commands: which there are, their help, and wrong input that ends in one line on stderr instead of a traceback.

Here belongs what all commands share; not what one of them does, which is in its room. Imports ``config``, and no torch:
``--help`` and wrong input are answered at once.
"""

from pace.command.arguments import quote
from pace.command.run import run_command

__all__ = ["quote", "run_command"]
