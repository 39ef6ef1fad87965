"""Process groups of one process that go the way of several: the exchange of gradients lies between two graphs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from pace.distributed import LOCAL_ADDRESS, ProcessGroup, _connected


class Echo(ProcessGroup):
    """A group of two with one process: the other has the same numbers."""

    def __init__(self) -> None:
        super().__init__(0, 2)
        self.messages: list[int] = []  # the numbers in each

    def all_reduce_mean_later(self, tensors: Sequence[Tensor]) -> Callable[[], None]:
        self.messages.append(sum(tensor.numel() for tensor in tensors))
        return lambda: None

    def all_reduce_sum_(self, tensor: Tensor) -> Tensor:
        return tensor

    def broadcast_(self, tensors: Sequence[Tensor]) -> None: ...

    def gather(self, value: Any) -> list[Any]:
        return [value]


class Connected(ProcessGroup):
    """Sends through torch.distributed, which has one process, and counts as two."""

    def __init__(self) -> None:
        super().__init__(0, 2)
        self.messages: list[int] = []  # the numbers in each

    def all_reduce_mean_later(self, tensors: Sequence[Tensor]) -> Callable[[], None]:
        self.messages.append(sum(tensor.numel() for tensor in tensors))
        finish = super().all_reduce_mean_later(tensors)

        def whole() -> None:
            finish()
            for tensor in tensors:
                tensor.mul_(self.size)  # exact: the sum of one process was halved

        return whole

    def gather(self, value: Any) -> list[Any]:
        return [value]


@contextmanager
def connected(device: torch.device) -> Iterator[Connected]:
    """A :class:`Connected` over gloo, and over NCCL for tensors on a GPU."""
    store = dist.TCPStore(LOCAL_ADDRESS, 0, is_master=True, wait_for_workers=False)
    with _connected(device, store=store, rank=0, world_size=1):
        yield Connected()
