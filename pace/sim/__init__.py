"""Physics of N table-tennis worlds: the robot, the ball and the robot's sensors. Knows nothing of learning.

The state of the world and its sensors belong here, not the robot's task. Imports ``arrays`` and the rooms below.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pace.arrays  # noqa: F401  sets Warp up before the first kernel is defined

if TYPE_CHECKING:
    from pace.sim.engine.factory import make_engine
    from pace.sim.worlds import Worlds

__all__ = ["Worlds", "make_engine"]


def __getattr__(name: str) -> Any:
    """Import on first use: the physics takes a while to load."""
    if name == "Worlds":
        from pace.sim.worlds import Worlds

        return Worlds
    if name == "make_engine":
        from pace.sim.engine.factory import make_engine

        return make_engine
    raise AttributeError(f"module 'pace.sim' has no attribute {name!r}")
