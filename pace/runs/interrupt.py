"""Ctrl-C and SIGTERM as a request that a loop can poll."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class StopRequest:
    """Set by the first Ctrl-C or SIGTERM; the current update is finished and saved, and the run ends."""

    def __init__(self) -> None:
        self.name: str | None = None

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Handle the two signals while the block runs; a second one acts as it would without this class."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

        def give_back() -> None:
            for number, handler in before.items():
                signal.signal(number, handler)

        def on_signal(number: int, _frame: object) -> None:
            self.name = signal.Signals(number).name
            give_back()

        for number in before:
            signal.signal(number, on_signal)
        try:
            yield
        finally:
            give_back()
