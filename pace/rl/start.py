"""A run that starts from the weights of another one: what has to be the same in both."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pace.config.base import to_dict
from pace.config.names import choices
from pace.config.training import TrainConfig

#: Of each group, what the shapes of the networks follow from.
SHAPING = {
    "robot": ("model",),
    "observation": ("policy", "policy_history", "critic", "critic_history"),
    "algo": ("actor_hidden", "critic_hidden"),
    "predictor": ("frames", "hidden", "outputs", "features"),
}


def other_choices(config: TrainConfig, saved: Mapping[str, Any]) -> str:
    """``; it was trained with observation=memory``: choices of ``saved`` that shape networks and are not those of
    ``config``; empty if there are none."""
    own = to_dict(config)
    found = []
    for group, keys in SHAPING.items():
        if any(saved[group].get(key) != own[group].get(key) for key in keys):
            name = saved[group].get("name")
            found.append(f"{group}={name}" if name in choices(group) else f"another {group}")
    return f"; it was trained with {' '.join(found)}" if found else ""
