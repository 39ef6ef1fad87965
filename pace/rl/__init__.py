"""Learning a policy: networks, rollouts, PPO, the training loop, and loading a trained policy.

The learner belongs here, not the task (``task``) and not its evaluation (``evaluation``). Imports
``task``, ``predictor``, ``runs`` and the rooms below. ``python -m pace.rl.train`` trains.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pace

if TYPE_CHECKING:
    from pace.rl.policies import load_policy
    from pace.task.env import make_env

__all__ = ["load_policy", "make_env"]


def __getattr__(name: str) -> Any:
    """The names of :mod:`pace` that users found here first."""
    if name in __all__:
        return getattr(pace, name)
    raise AttributeError(f"module 'pace.rl' has no attribute {name!r}")
