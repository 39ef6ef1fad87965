"""The progress display of a training run: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress

from tqdm import tqdm

from pace.runs.files import tell

SECONDS_PER_LINE = 15.0
RATES = {  # column: label, factor, digits, unit
    "hit_rate": ("hit", 100.0, 1, " %"),
    "success_rate": ("return", 100.0, 1, " %"),
    "fall_rate": ("falls", 1.0, 3, "/s"),
    "predictor_rmse_cm": ("predictor", 1.0, 1, " cm"),
}
FIRST = ("hit_rate", "success_rate")  # of the rates
#: Columns of a judgement without exploration: hits and returns.
JUDGED = ("eval_hit", "eval_success")
#: Column of a fault -> its total in words.
FAULTS = {"diverged": "{} worlds diverged", "skipped": "{} updates skipped"}
WINDOW = 25  # updates over which the shown rates are taken


def clock(seconds: float) -> str:
    """``h:mm:ss`` or ``mm:ss``; ``--:--`` without an end."""
    if math.isinf(seconds):
        return "--:--"
    whole = max(0, round(seconds))
    hours, rest = divmod(whole, 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60:02d}:{rest % 60:02d}"


def rate_texts(rates: dict[str, float]) -> list[str]:
    """Rates (keys of :data:`RATES`) in words; a dash if nothing was counted yet."""
    texts = []
    for name, rate in rates.items():
        label, factor, digits, unit = RATES[name]
        value = factor * rate
        texts.append(f"{label} -" if math.isnan(value) else f"{label} {value:.{digits}f}{unit}")
    return texts


class Progress:
    """Progress towards the end of a run. ``samples`` is the limit in control steps, ``seconds`` that of the clock,
    ``shown`` the columns to show."""

    def __init__(
        self,
        enabled: bool,
        samples: float,
        seconds: float,
        first_samples: float = 0.0,
        shown: Sequence[str] = tuple(RATES),
    ) -> None:
        self.shown = tuple(shown)
        self.samples, self.seconds, self.first_samples = samples, seconds, first_samples
        self.recent: deque[dict[str, float]] = deque(maxlen=WINDOW)
        #: Totals of the run's faults: worlds that diverged, updates that were skipped.
        self.faults = dict.fromkeys(FAULTS, 0.0)
        self._judged: dict[str, float] = {}
        self.started = time.monotonic()
        self._last_line = -math.inf
        self._enabled = enabled
        self._bar: tqdm | None = None
        if enabled and sys.stderr.isatty():
            self._bar = tqdm(total=1.0, bar_format="{percentage:3.0f}%|{bar:16}| {desc}", dynamic_ncols=True)

    def show(self, row: dict[str, float]) -> None:
        """Add the row of one update and show the state of the run."""
        self.recent.append(row)
        for name in FAULTS:
            self.faults[name] += row.get(name, 0.0)
        self._judged |= {name: row[name] for name in JUDGED if name in row}
        if not self._enabled:
            return
        fraction, left = self._remaining(row["samples"])
        text = self._describe(row, left)
        if self._bar is not None:
            with suppress(OSError):  # the terminal is gone
                self._bar.n = fraction
                self._bar.set_description_str(text)
        elif time.monotonic() - self._last_line >= SECONDS_PER_LINE:
            self._last_line = time.monotonic()
            tell(f"{100 * fraction:3.0f} % | {text}")

    def say(self, text: str) -> None:
        """A line of its own, above the bar if there is one."""
        if self._bar is not None:
            self._bar.write(text)
        else:
            print(text, flush=True)

    def _remaining(self, samples: float) -> tuple[float, float]:
        """Share of the run that is done, and seconds that are left, by whichever limit comes first."""
        elapsed = time.monotonic() - self.started
        speed = (samples - self.first_samples) / max(elapsed, 1e-9)
        left = (self.samples - samples) / max(speed, 1e-9)
        if self.seconds > 0:
            left = min(left, self.seconds - elapsed)
        left = max(left, 0.0)
        done = 0.0 if math.isinf(left) else elapsed / max(elapsed + left, 1e-9)
        return done, left

    def _describe(self, row: dict[str, float], left: float) -> str:
        first, rest = {}, {}
        for name, rate in self.rates().items():
            (first if name in FIRST else rest)[name] = rate
        parts = [  # what matters most comes first: a terminal of 80 columns cuts the line
            f"{clock(left)} left",
            *rate_texts(first),
            *self.judged_texts(),
            *self.fault_texts(),
            f"{row['samples'] / 1e6:.2f} M samples",
            f"{self.mean('samples_per_s'):,.0f}/s",
            *rate_texts(rest),
            f"update {row['update']:.0f}",
        ]
        return " | ".join(parts)

    def judged_texts(self) -> list[str]:
        """The last judgement in words; nothing without one."""
        shares = [f"{100.0 * self._judged[name]:.0f}" for name in JUDGED if name in self._judged]
        return [f"judged {'/'.join(shares)} %"] if shares else []

    def fault_texts(self) -> list[str]:
        """The run's faults in words; nothing without one."""
        return [text.format(round(self.faults[name])) for name, text in FAULTS.items() if self.faults[name]]

    def rates(self) -> dict[str, float]:
        """The shown rates over the last updates."""
        return {name: self.mean(name) for name in self.shown}

    def mean(self, name: str) -> float:
        """Mean of a column over the last updates, without NaN; NaN if no value is left."""
        values = [row[name] for row in self.recent if not math.isnan(row.get(name, math.nan))]
        return sum(values) / len(values) if values else math.nan

    def close(self) -> None:
        """Close the bar."""
        if self._bar is not None:
            with suppress(OSError):
                self._bar.close()
