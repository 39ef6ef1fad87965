"""Learning a policy: networks, rollouts, PPO, the training loop, and loading a trained policy.

The learner belongs here, not the task (``task``) and not its evaluation (``evaluation``). Imports
``task``, ``predictor``, ``runs`` and the rooms below. ``python -m pace.rl.train`` trains.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pace.lazy import on_first_use

if TYPE_CHECKING:
    from pace.rl.environment import make_env
    from pace.rl.policies import load_policy

__all__ = ["load_policy", "make_env"]

# Names of :mod:`pace` that users found here first.
__getattr__ = on_first_use(__name__, {"load_policy": "pace.rl.policies", "make_env": "pace.rl.environment"})
