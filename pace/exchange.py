"""Sums over the processes of one machine, through memory that they share.

gloo sends a gradient through the loopback device, which takes milliseconds; small updates have dozens a second. Here
each process writes its part into a slot of its own and tells the others; once all have told, each adds up all slots in
the same order, so the sums are equal bit for bit. A process that waits sleeps in the kernel: it takes no time from
others.
"""

from __future__ import annotations

import mmap
import os
import select
import tempfile
from collections.abc import Callable

import torch
from torch import Tensor

CAPACITY = 32 * 2**20  # bytes of a slot, address space only: what no message touches takes no memory
OUTSTANDING = 2  # messages that a process may have sent before it has received the sum of the first
SETS = 2 * OUTSTANDING  # of slots: whoever writes into one again has heard that all have read what was in it
MOST = 256  # processes: a message is told of by the rank, one byte
PATIENCE = 0.5  # s between two looks whether the others still live


def nobody_failed() -> None:
    """Of a process that need not look after others."""


class Exchange:
    """Rank ``rank`` of the processes that have the files ``shared``. All of them send the same messages in the same
    order.

    Args: require_all: called while it waits, every half second; raises if a process has failed.
    """

    def __init__(self, rank: int, shared: Shared, require_all: Callable[[], None] = nobody_failed) -> None:
        self._rank, self._require_all = rank, require_all
        pipes, size = shared.pipes, len(shared.pipes)
        mapped = mmap.mmap(shared.memory, SETS * size * CAPACITY)
        self._slots = torch.frombuffer(mapped, dtype=torch.uint8).view(SETS, size, CAPACITY)
        self._inbox = pipes[rank][0]
        self._outboxes = [pipes[other][1] for other in range(size) if other != rank]
        self._waiting = select.poll()
        self._waiting.register(self._inbox, select.POLLIN)
        self._heard = [0] * size  # messages that each rank has told of
        self._sent = self._received = 0

    def takes(self, tensor: Tensor) -> bool:
        """Whether :meth:`send` can take ``tensor`` now; all processes find the same."""
        lies_well = tensor.device.type == "cpu" and tensor.is_contiguous()
        fits = tensor.numel() * tensor.element_size() <= CAPACITY
        return lies_well and fits and self._sent - self._received < OUTSTANDING

    def send(self, tensor: Tensor) -> Callable[[], None]:
        """Send a contiguous tensor; calling the returned function replaces it by the sum over the processes."""
        assert self.takes(tensor)
        message = self._sent
        slots = self._slots[message % SETS, :, : tensor.numel() * tensor.element_size()].view(tensor.dtype)
        slots[self._rank].copy_(tensor.view(-1))
        self._sent += 1
        self._heard[self._rank] += 1
        for outbox in self._outboxes:
            os.write(outbox, bytes([self._rank]))

        def receive() -> None:
            assert message == self._received
            while min(self._heard) <= message:
                self._listen()
            flat = torch.add(slots[0], slots[1], out=tensor.view(-1))
            for slot in slots[2:]:
                flat.add_(slot)
            self._received += 1

        return receive

    def _listen(self) -> None:
        """Sleep until another process tells of a message."""
        while not self._waiting.poll(1000.0 * PATIENCE):
            self._require_all()
        for rank in os.read(self._inbox, 4096):
            self._heard[rank] += 1


class Shared:
    """The files of an :class:`Exchange`, which rank 0 opens and the others inherit.

    Args: memory: of all slots; pipes: read and write end of a pipe a rank, of which each process reads its own.
    """

    def __init__(self, memory: int, pipes: list[tuple[int, int]]) -> None:
        self.memory, self.pipes = memory, pipes

    @classmethod
    def open(cls, size: int) -> Shared:
        """New files for ``size`` processes. Errors: :class:`OSError` if the system grants none."""
        if hasattr(os, "memfd_create"):
            memory = os.memfd_create("pace")
        else:
            with tempfile.TemporaryFile() as file:
                memory = os.dup(file.fileno())
        os.ftruncate(memory, SETS * size * CAPACITY)
        return cls(memory, [os.pipe() for _ in range(size)])

    @classmethod
    def inherited(cls, text: str) -> Shared:
        """Of the text of :meth:`describe`."""
        memory, *ends = (int(part) for part in text.split())
        return cls(memory, list(zip(ends[::2], ends[1::2], strict=True)))

    def describe(self) -> str:
        """The numbers of the files, for a process that inherits them."""
        return " ".join(str(number) for number in self.numbers())

    def numbers(self) -> list[int]:
        """Of all files."""
        return [self.memory, *(end for pipe in self.pipes for end in pipe)]

    def close(self) -> None:
        """Close the files of this process; what it has mapped stays."""
        for number in self.numbers():
            os.close(number)
