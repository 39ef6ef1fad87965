"""The step and the reset never wait for the device: nothing in them reads a tensor's value on the host.

Shown on the CPU device, where a wait costs nothing but takes the same calls; ``test_graph.py`` shows that both can be
replayed as CUDA graphs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

import pytest
import torch
import warp as wp
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from pace.predictor.network import PredictorNetwork
from pace.task.env import TableTennisEnv
from tests.helpers.emulation import without_replay
from tests.helpers.fakes import config

N = 4
#: Operators whose result, or its shape, the host must wait for.
WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "equal", "is_nonzero")
#: Methods of a tensor that hand its values to the host without an operator when it lies there already.
HANDING_OVER = ("numpy", "tolist", "cpu", "__array__")
#: Functions that carry values of the host to the device.
BRINGING = ("tensor", "as_tensor", "asarray", "from_numpy")


NUMBERS = torch.tensor([1.0, -1.0])


class Waits(AssertionError):
    """A call that would wait for the device."""


class NoWaiting(TorchDispatchMode):
    """Refuses operators that wait: those of WAITING, and an index by a mask, whose size only the device knows."""

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        if name.startswith(WAITING) or (name.startswith("index") and any(map(_is_mask, _indices(args)))):
            raise Waits(str(func))
        return func(*args, **(kwargs or {}))


def _indices(args: tuple[Any, ...]) -> list[Any]:
    return list(args[1]) if len(args) > 1 and isinstance(args[1], (list, tuple)) else []


def _is_mask(index: Any) -> bool:
    return isinstance(index, Tensor) and index.dtype in (torch.bool, torch.uint8)


def _refuse(name: str) -> Any:
    def refuse(*_args: Any, **_kwargs: Any) -> NoReturn:
        raise Waits(name)

    return refuse


@contextmanager
def no_waiting() -> Iterator[None]:
    """Within it, whatever would wait for the device raises :class:`Waits`; a tensor made on no named device is on none,
    as on a GPU it would have to be carried there."""
    with pytest.MonkeyPatch.context() as patch, NoWaiting(), torch.device("meta"):
        for name in HANDING_OVER:
            patch.setattr(torch.Tensor, name, _refuse(name))
        for name in BRINGING:
            patch.setattr(torch, name, _refuse(name))
        for name in ("synchronize", "synchronize_device", "synchronize_stream", "synchronize_event"):
            patch.setattr(wp, name, _refuse(name))
        patch.setattr(wp.array, "numpy", _refuse("wp.array.numpy"))
        patch.setattr(wp.array, "list", _refuse("wp.array.list"))
        yield


@pytest.mark.parametrize(
    "call",
    [
        lambda t: t.sum().item(),
        lambda t: bool(t.any()),
        lambda t: float(t[0]),
        lambda t: t.nonzero(),
        lambda t: t[t > 0],
        lambda t: t.masked_select(t > 0),
        lambda t: t.index_put_((t > 0,), torch.ones(())),
        lambda t: t.numpy(),
        lambda t: t.cpu(),
        lambda t: t.tolist(),
        lambda t: t.copy_(torch.tensor([1.0, 2.0])),
        lambda t: t + torch.ones(2),
        lambda t: wp.from_torch(t).numpy(),
        lambda t: wp.synchronize(),
    ],
)
def test_a_wait_is_found(call: Any) -> None:
    with no_waiting(), pytest.raises((Waits, RuntimeError)):
        call(NUMBERS)


def test_neither_step_nor_reset_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    without_replay(monkeypatch)
    settings = config("engine=mjwarp", "engine.graph=dry", "randomization.push_interval=[0.02,0.04]")
    env = TableTennisEnv(settings, N, "cpu", 1, PredictorNetwork(settings.predictor))
    generator = torch.Generator().manual_seed(0)
    actions = 0.5 * torch.randn(5, N, 21, generator=generator)
    masks = torch.rand(5, N, generator=generator) < 0.5
    env.advance(actions[0])  # kernels are compiled, and tensors bound, at the first step
    env.reset_worlds(masks[0])
    with no_waiting():
        for action, mask in zip(actions[1:].unbind(), masks[1:].unbind(), strict=True):
            env.advance(action)
            env.reset_worlds(mask)
    assert env.policy_observation.isfinite().all()
    assert not env.worlds.engine.overflowed()
