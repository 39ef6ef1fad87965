"""PACE: humanoid table tennis by predictor-aided reinforcement learning, on MuJoCo Warp and TorchRL.

A notebook begins with ``pace.make_env`` and ``pace.load_policy``; ``python -m pace`` lists the commands.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from pace.lazy import on_first_use
from pace.moved import MovedCommands

if TYPE_CHECKING:
    from pace.rl.policies import load_policy
    from pace.task.env import make_env

__version__ = "0.2.0"
__all__ = ["load_policy", "make_env"]
sys.meta_path.append(MovedCommands())

__getattr__ = on_first_use(__name__, {"load_policy": "pace.rl.policies", "make_env": "pace.task.env"})
