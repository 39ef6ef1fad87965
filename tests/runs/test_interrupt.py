"""Signals as requests: the first is noted, a second Ctrl-C acts at once, a second SIGTERM does not."""

from __future__ import annotations

import os
import signal

import pytest

from pace.command import Terminated
from pace.runs.interrupt import SIGNALS, StopRequest, terminable


def send(number: int) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_scheduler_may_repeat_its_signal_while_the_work_is_saved(number: int) -> None:
    before = [signal.getsignal(each) for each in SIGNALS]
    stop = StopRequest()
    with stop.listening():
        for _ in range(3):
            send(number)
        assert stop.name == signal.Signals(number).name
    assert [signal.getsignal(each) for each in SIGNALS] == before
    with pytest.raises(Terminated):
        stop.require_not_terminated()


@pytest.mark.parametrize("first", SIGNALS)
def test_ctrl_c_after_a_signal_acts_at_once(first: int) -> None:
    stop = StopRequest()

    def work() -> None:
        with stop.listening():
            send(first)
            send(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert stop.name == signal.Signals(first).name


def test_a_command_that_has_begun_cleans_up_after_its_first_signal() -> None:
    cleaned = []

    def work() -> None:
        with terminable():
            try:
                send(signal.SIGTERM)
            finally:
                send(signal.SIGTERM)
                cleaned.append(True)

    with pytest.raises(Terminated):
        work()
    assert cleaned == [True]
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
