"""Ctrl-C, SIGTERM and a lost terminal as a request that a loop can poll."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from pace.command import Terminated

SIGNALS = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))


class StopRequest:
    """Set by the first Ctrl-C, SIGTERM or SIGHUP; the current update is finished and saved, and the run ends.

    Attributes: ``name`` of the signal, or None. A signal that is ignored, as SIGHUP is under ``nohup``, stays so.
    """

    def __init__(self) -> None:
        self.name: str | None = None

    def require_not_terminated(self) -> None:
        """Errors: :class:`Terminated` if a signal other than Ctrl-C came."""
        if self.name is not None and self.name != signal.SIGINT.name:
            raise Terminated

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Handle the signals while the block runs; a second one acts as it would without this class."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.getsignal(number) for number in SIGNALS}
        before = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}

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
