"""Table tennis as a task: the environment, its referee, resets, observations, rewards and statistics.

The robot's task and its observations belong here, not learning. Imports ``onboard`` and the rooms below.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pace.lazy import on_first_use

if TYPE_CHECKING:
    from pace.task.env import TableTennisEnv

__all__ = ["TableTennisEnv"]

__getattr__ = on_first_use(__name__, {"TableTennisEnv": "pace.task.env"})
