"""Ctrl-C, SIGTERM and a lost terminal as a request that a loop can poll."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any

from pace.command import Terminated

Handler = Callable[[int, FrameType | None], Any] | int | None
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
        """Handle the signals while the block runs.

        A second Ctrl-C acts as it would without this class. A scheduler may send SIGTERM again while the work is saved:
        that, and SIGHUP, change nothing.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.getsignal(number) for number in SIGNALS}
        before = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}

        def on_signal(number: int, _frame: object) -> None:
            self.name = self.name or signal.Signals(number).name
            if signal.SIGINT in before:
                signal.signal(signal.SIGINT, before[signal.SIGINT])

        with _handled(before, on_signal):
            yield


@contextmanager
def terminable() -> Iterator[None]:
    """The first SIGTERM or SIGHUP in the block raises :class:`Terminated`, which cleans up; later ones are ignored."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS[1:]}
    before = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}

    def on_signal(_number: int, _frame: object) -> None:
        for number in before:
            signal.signal(number, lambda *_: None)  # not SIG_IGN, which processes that are started would inherit
        raise Terminated

    with _handled(before, on_signal):
        yield


@contextmanager
def _handled(before: Mapping[signal.Signals, Handler], on_signal: Callable[[int, object], None]) -> Iterator[None]:
    """``on_signal`` for those signals; their handlers ``before`` are put back at the end."""
    for number in before:
        signal.signal(number, on_signal)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
