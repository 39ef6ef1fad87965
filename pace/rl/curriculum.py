"""Tasks that follow one another in a run: the worlds are rebuilt when a stage of the curriculum begins."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from pace.config.overrides import stage_tasks
from pace.config.schedules import Position
from pace.config.training import TrainConfig

Worlds = TypeVar("Worlds")


class Curriculum(Generic[Worlds]):
    """Makes the worlds of each stage; the networks and all other learned state stay.

    Args:
        config: of the run; its task is the first stage, ``config.curriculum`` has the others.
        make: worlds of a task, given its configuration and the number of the stage, 0 for the first.
        at: where the run is; :attr:`worlds` are made for the stage of that place.

    Attributes: ``tasks`` the configuration of each stage; ``stage`` the current one, ``worlds`` those made for it.
    Errors: :class:`ConfigError`, which names the stage, for changes of unknown keys.
    """

    def __init__(self, config: TrainConfig, make: Callable[[TrainConfig, int], Worlds], at: Position) -> None:
        self.tasks = stage_tasks(config)
        self._later = config.curriculum
        self._make = make
        self.stage = self._due(at)
        self.worlds = make(self.tasks[self.stage], self.stage)

    def _due(self, at: Position) -> int:
        return sum(stage.reached(at) for stage in self._later)

    def move_on(self, at: Position) -> bool:
        """Make new worlds if another stage has begun ``at`` this place; returns whether it has."""
        due = self._due(at)
        if due == self.stage:
            return False
        self.stage = due
        self.worlds = self._make(self.tasks[due], due)
        return True
