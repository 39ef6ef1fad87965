"""Commands: which there are, their help, and wrong input that ends in one line on stderr instead of a traceback.

Here belongs what all commands share; what one of them does is in its room. Imports ``config``; loads no torch, so that
``--help`` and wrong input are answered at once."""

from pace.command.arguments import quote
from pace.command.run import run_command

__all__ = ["quote", "run_command"]
