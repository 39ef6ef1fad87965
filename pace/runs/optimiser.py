"""Adam for networks whose updates may be graphs, and the state of an optimiser in the form of a checkpoint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from pace.runs.reading import decimal


def adam(parameters: Sequence[nn.Parameter], rate: float) -> torch.optim.Adam:
    """Adam in one operator, which a graph can hold. Its learning rate is a tensor (), to be changed in place."""
    device = parameters[0].device
    held = torch.tensor(rate, dtype=torch.float32, device=device)
    return torch.optim.Adam(parameters, lr=held, fused=True, capturable=device.type == "cuda")


def learning_rate(optimiser: torch.optim.Optimizer) -> Tensor:
    """The learning rate of an :func:`adam`, the tensor itself."""
    return optimiser.param_groups[0]["lr"]


def optimiser_state(optimiser: torch.optim.Optimizer) -> dict[str, Any]:
    """Adam's state with string keys only, ready for a checkpoint; the learning rate is a number."""
    state = live_state(optimiser)
    rate = state["lr"]
    return state | {"lr": decimal(rate.item()) if isinstance(rate, Tensor) else rate}


def live_state(optimiser: torch.optim.Optimizer) -> dict[str, Any]:
    """:func:`optimiser_state` without a wait for the device: its own tensors, the learning rate of :func:`adam` too."""
    state = optimiser.state_dict()
    moments = {str(index): entry for index, entry in state["state"].items()}
    return {"lr": state["param_groups"][0]["lr"], "moments": moments}


def load_optimiser_state(optimiser: torch.optim.Optimizer, saved: dict[str, Any]) -> None:
    """Inverse of :func:`optimiser_state` and of :func:`live_state`, for an optimiser over the same parameters.

    Tensors that it has stay the same: whoever steers the learning rate, and graphs, know them by address.
    """
    rate, moments = optimiser.param_groups[0]["lr"], dict(optimiser.state)
    state = optimiser.state_dict()
    state["state"] = {int(index): entry for index, entry in saved["moments"].items()}
    optimiser.load_state_dict(state)
    for parameter, kept in moments.items():
        loaded = optimiser.state[parameter]
        for name, tensor in kept.items():
            tensor.copy_(loaded[name]) if name in loaded else tensor.zero_()
            loaded[name] = tensor
    optimiser.param_groups[0]["lr"] = rate.fill_(saved["lr"]) if isinstance(rate, Tensor) else saved["lr"]
