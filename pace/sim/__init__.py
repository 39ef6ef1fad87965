"""Physics of N table-tennis worlds: the robot, the ball and the robot's sensors. Knows nothing of learning.

The state of the world and its sensors belong here, not the robot's task. Imports ``arrays`` and the rooms below.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pace.arrays  # noqa: F401  sets Warp up before the first kernel is defined
from pace.lazy import on_first_use

if TYPE_CHECKING:
    from pace.sim.engine.factory import make_engine
    from pace.sim.worlds import Worlds

__all__ = ["Worlds", "make_engine"]

__getattr__ = on_first_use(__name__, {"Worlds": "pace.sim.worlds", "make_engine": "pace.sim.engine.factory"})
