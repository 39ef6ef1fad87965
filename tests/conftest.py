"""Settings of the whole test suite: threads, and the order of the tests."""

import pytest
import torch

torch.set_num_threads(1)  # tests work on small tensors: more threads would mostly wait for each other


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The fast tests first: most faults are seen in the first minutes."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)
