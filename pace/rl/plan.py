"""How many control steps a run will have: its schedules in shares are shares of that number."""

from __future__ import annotations

import math

from pace.config.schedules import Position, position
from pace.config.training import TrainConfig


def in_millions(samples: float) -> str:
    """``17.9 M control steps``; fewer than a million have more digits."""
    return f"{samples / 1e6:.1f} M control steps" if samples >= 1e6 else f"{samples:,.0f} control steps"


class Plan:
    """The planned number of control steps, fixed once in a run and kept in its checkpoints.

    With ``minutes`` it is ``samples``, or the measured speed times ``minutes`` if that is less; with ``samples`` alone
    it is those; without an end it is ``plan.samples``. Until it is fixed, a run is at the share 0.

    Attributes: ``samples`` the planned number; None: not fixed, or no schedule of ``config`` is in shares.
    """

    def __init__(self, config: TrainConfig) -> None:
        self.config = config
        self.samples: float | None = self._known() if config.in_shares else None
        self._updates = 0
        self._from = (0.0, 0.0)  # control steps and seconds at which the measurement began

    def _known(self) -> float | None:
        """What follows from the configuration alone."""
        if self.config.minutes > 0:
            return None
        return self.config.plan.samples if math.isinf(self.config.samples) else self.config.samples

    @property
    def open(self) -> bool:
        """Whether it is still to be fixed, by :meth:`measure`."""
        return self.samples is None and self.config.in_shares

    def position(self, samples: float) -> Position:
        """Where the run is after ``samples`` control steps."""
        return position(samples, self.samples)

    def measure(self, samples: float, seconds: float) -> tuple[float, str] | None:
        """After each update of this process, ``samples`` control steps of the run and ``seconds`` since it began.

        Returns the plan and a line that says it, once the speed is known.
        """
        self._updates += 1
        wanted = self.config.plan
        if self._updates <= wanted.warm_up:
            self._from = (samples, seconds)
            return None
        measured = seconds - self._from[1]
        if self._updates < wanted.warm_up + wanted.updates or measured < wanted.seconds:
            return None
        rate = (samples - self._from[0]) / measured
        planned = min(self.config.samples, samples + rate * max(60.0 * self.config.minutes - seconds, 0.0))
        return planned, f"planned: {in_millions(planned)} ({rate:,.0f}/s for {self.config.minutes:g} min)"
