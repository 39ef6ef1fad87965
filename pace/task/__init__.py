"""Table tennis as a task: the environment, its referee, resets, observations, rewards and statistics.

The robot's task and its observations belong here, not learning. Imports ``onboard`` and the rooms below.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pace.task.env import TableTennisEnv

__all__ = ["TableTennisEnv"]


def __getattr__(name: str) -> Any:
    """Import on first use: the simulation takes a while to load."""
    if name == "TableTennisEnv":
        from pace.task.env import TableTennisEnv

        return TableTennisEnv
    raise AttributeError(f"module 'pace.task' has no attribute {name!r}")
