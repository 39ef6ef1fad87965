"""What a training run asks of whoever judges it: rooms above this one play, and the command brings both together."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

#: Columns of the metrics that a quick judgement fills: shares of its serves.
JUDGED = ("eval_hit", "eval_success")


class Judge(Protocol):
    """Judges a run's policy without exploration."""

    def quick(self, checkpoint: Path, minutes: float) -> dict[str, float]:
        """:data:`JUDGED` of a checkpoint of a run that has trained for ``minutes``; empty if it was not judged."""
        ...

    def last(self, run: Path, minutes: float) -> None:
        """Tell what the newest checkpoint of a finished run does, and write it into the run's folder."""
        ...
