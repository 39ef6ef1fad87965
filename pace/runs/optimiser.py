"""The state of an optimiser in the form of a checkpoint."""

from __future__ import annotations

from typing import Any

import torch


def optimiser_state(optimiser: torch.optim.Optimizer) -> dict[str, Any]:
    """Adam's state with string keys only, ready for a checkpoint."""
    state = optimiser.state_dict()
    moments = {str(index): entry for index, entry in state["state"].items()}
    return {"lr": state["param_groups"][0]["lr"], "moments": moments}


def load_optimiser_state(optimiser: torch.optim.Optimizer, saved: dict[str, Any]) -> None:
    """Inverse of :func:`optimiser_state`, for an optimiser over the same parameters."""
    state = optimiser.state_dict()
    state["state"] = {int(index): entry for index, entry in saved["moments"].items()}
    state["param_groups"][0]["lr"] = saved["lr"]
    optimiser.load_state_dict(state)
