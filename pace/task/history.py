"""The last frames of a network's observations, of N worlds.

At reset of a world all its frames are the current one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from pace.arrays.graph import may_look
from pace.arrays.state import Stateful
from pace.task.signals import put


class Frame:
    """Observations that are concatenated to a frame.

    If a function returns the same memory each time, its signal is read in place; if it returns a new tensor each time,
    the signal is copied to a separate tensor. This is checked once, at the start, so a function must not change it.

    Attributes: ``tensors``, (N, size) float32 each, with the values of the last :meth:`compute`.

    Args: functions: each returns a signal (N, size), float32 or bool.
    """

    def __init__(self, functions: Sequence[Callable[[], Tensor]]) -> None:
        self.tensors: list[Tensor] = []
        self._computed: list[tuple[Callable[[], Tensor], Tensor]] = []
        for function in functions:
            signal, again = function(), function()  # both alive, or the second could reuse the memory of the first
            if signal.data_ptr() != again.data_ptr() or signal.dtype != torch.float32:
                signal = signal.float()
                self._computed.append((function, signal))
            self.tensors.append(signal)

    def compute(self) -> None:
        """Bring all of them up to date."""
        for function, signal in self._computed:
            signal.copy_(function())


class History(Stateful):
    """The last H frames of N worlds.

    Attributes: ``frame`` (N, D) the newest, ``observation`` (N, H * D) all of them, oldest first, ``frames``
    (N, H, D) the same.

    Args: frames: H; functions: of the signals that make a frame, as :class:`Frame` wants them.
    """

    STATE = ("frame", "observation")

    def __init__(self, frames: int, functions: Sequence[Callable[[], Tensor]]) -> None:
        self._signals = Frame(functions)
        tensors = self._signals.tensors
        size, count, device = sum(tensor.shape[1] for tensor in tensors), len(tensors[0]), tensors[0].device
        self.frame = torch.zeros(count, size, device=device)
        self.observation = torch.zeros(count, frames * size, device=device)
        self.frames = self.observation.view(count, frames, size)

    def push(self) -> None:
        """Append a frame made of the current signals."""
        self._signals.compute()
        torch.cat(self._signals.tensors, dim=1, out=self.frame)
        for older in range(self.frames.shape[1] - 1):  # twice as fast as a kernel, which Warp does not vectorise
            self.frames[:, older].copy_(self.frames[:, older + 1])
        self.frames[:, -1].copy_(self.frame)

    def fill(self, mask: Tensor) -> None:
        """Set all frames of the worlds of ``mask`` (N,) bool to one made of the current signals."""
        self._signals.compute()
        rows = mask.nonzero().squeeze(1) if may_look(mask) else slice(None)
        frame = torch.cat([signal[rows] for signal in self._signals.tensors], dim=1)
        put(self.frame, frame, mask, rows)
        put(self.frames, frame.unsqueeze(1), mask, rows)
