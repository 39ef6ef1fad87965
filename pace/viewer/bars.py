"""Reward terms as bars, for the page of ``pace watch``."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

MEMORY = 1.0  # s, in which a past reward falls to 1/e
SCALE_MEMORY = 20.0  # s, likewise for the largest bar, which sets the scale
LEAST_SCALE = 0.01  # reward/s of a full bar, at least
PAID, CHARGED = "#4caf50", "#e05252"

Array = NDArray[np.float64]


class RewardBars:
    """Moving means of the weighted reward terms, in reward per second.

    Attributes: ``names`` of the T terms, ``rates`` (T,) reward/s.

    Args: names: of the terms; dt: s between two updates.
    """

    def __init__(self, names: Sequence[str], dt: float) -> None:
        self.names = tuple(names)
        self.rates = np.zeros(len(self.names))
        self._dt, self._scale = dt, LEAST_SCALE

    def update(self, rewards: Array) -> None:
        """Take in the weighted terms (T,) of one control step."""
        share = min(self._dt / MEMORY, 1.0)
        self.rates += share * (np.nan_to_num(rewards) / self._dt - self.rates)
        largest = float(np.abs(self.rates).max(initial=0.0))
        self._scale = max(largest, self._scale * (1.0 - self._dt / SCALE_MEMORY), LEAST_SCALE)

    def html(self) -> str:
        """A row a term: name, bar to the right (paid) or left (charged) of the middle, and number; the sum below."""
        rows = [self._row(name, rate) for name, rate in zip(self.names, self.rates, strict=True)]
        total = f'<div style="text-align:right">sum {self.rates.sum():+.2f} /s</div>'
        return f'<div style="font-size:0.75em;padding:0 0.8em">{"".join(rows)}{total}</div>'

    def _row(self, name: str, rate: float) -> str:
        share = 50.0 * min(abs(rate) / self._scale, 1.0)
        left, colour = (50.0, PAID) if rate >= 0.0 else (50.0 - share, CHARGED)
        bar = f"position:absolute;left:{left:.1f}%;width:{share:.1f}%;top:0;bottom:0;background:{colour}"
        return (
            '<div style="display:flex;gap:0.5em;align-items:center">'
            f'<span style="flex:0 0 9.5em;overflow:hidden;text-overflow:ellipsis">{escape(name)}</span>'
            '<span style="position:relative;flex:1;height:0.7em;background:rgba(128,128,128,0.2)">'
            f'<span style="{bar}"></span></span>'
            f'<span style="flex:0 0 3.6em;text-align:right">{rate:+.2f}</span></div>'
        )
