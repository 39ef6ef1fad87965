"""The progress bar of a row of serves."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

from pace.evaluation.serves import OnCount
from pace.runs.progress import SECONDS_PER_LINE


@contextmanager
def serve_bar(label: str, total: int, shown: bool) -> Iterator[OnCount]:
    """A progress bar of ``total`` serves, as a function of their number."""
    interval = 0.2 if sys.stderr.isatty() else SECONDS_PER_LINE
    with tqdm(total=total, desc=f"{label:<10}", unit="serve", disable=not shown, mininterval=interval) as bar:

        def show(counted: int) -> None:
            bar.update(min(counted, total) - bar.n)

        yield show
