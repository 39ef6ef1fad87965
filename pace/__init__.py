"""PACE: humanoid table tennis by predictor-aided reinforcement learning, on MuJoCo Warp and TorchRL.

A notebook begins with ``pace.make_env`` and ``pace.load_policy``; ``python -m pace`` lists the commands.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from pace.moved import MovedCommands

if TYPE_CHECKING:
    from pace.rl.policies import load_policy
    from pace.task.env import make_env

__version__ = "0.1.0"
__all__ = ["load_policy", "make_env"]
sys.meta_path.append(MovedCommands())


def __getattr__(name: str) -> Any:
    """Import on first use, so that ``import pace`` stays light."""
    if name == "load_policy":
        from pace.rl.policies import load_policy

        return load_policy
    if name == "make_env":
        from pace.task.env import make_env

        return make_env
    raise AttributeError(f"module 'pace' has no attribute {name!r}")
