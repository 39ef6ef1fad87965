"""Settings of the whole test suite: threads, and the order of the tests."""

import signal

import pytest
import torch

torch.set_num_threads(1)  # tests work on small tensors: more threads would mostly wait for each other
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # a shell's background jobs ignore Ctrl-C, which tests press
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The fast tests first: most faults are seen in the first minutes."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)
