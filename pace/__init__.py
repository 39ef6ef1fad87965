"""PACE: humanoid table tennis by predictor-aided reinforcement learning, on MuJoCo Warp and TorchRL.

A notebook begins with ``pace.make_env`` and ``pace.load_policy``; ``python -m pace`` lists the commands.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from pace.lazy import on_first_use
from pace.moved import MovedCommands

if TYPE_CHECKING:
    from pace.rl.environment import make_env
    from pace.rl.policies import load_policy

__version__ = "0.2.0"
__all__ = ["load_policy", "make_env"]
sys.meta_path.append(MovedCommands())
# OpenMP reads it when torch is loaded. Its threads would spin while they wait for one another, and take the cores from
# whoever shares them, a run's own too: beside other programs, one process does five times the steps if they sleep.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__getattr__ = on_first_use(__name__, {"load_policy": "pace.rl.policies", "make_env": "pace.rl.environment"})
