"""Tasks that follow one another in a run: the worlds are rebuilt when a stage of the curriculum begins."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from pace.config.overrides import stage_tasks
from pace.config.training import TrainConfig

Worlds = TypeVar("Worlds")


class Curriculum(Generic[Worlds]):
    """Makes the worlds of each stage; the networks and all other learned state stay.

    Args:
        config: of the run; its task is the first stage, ``config.curriculum`` has the others.
        make: worlds of a task, given its configuration and the number of the stage, 0 for the first.
        samples: control steps of the run so far; :attr:`worlds` are made for the stage that they are in.

    Attributes: ``tasks`` the configuration of each stage; ``stage`` the current one, ``worlds`` those made for it.
    Errors: :class:`ConfigError`, which names the stage, for changes of unknown keys.
    """

    def __init__(self, config: TrainConfig, make: Callable[[TrainConfig, int], Worlds], samples: float) -> None:
        self.tasks = stage_tasks(config)
        self._begins = [0.0, *(stage.samples for stage in config.curriculum)]
        self._make = make
        self.stage = self._due(samples)
        self.worlds = make(self.tasks[self.stage], self.stage)

    def _due(self, samples: float) -> int:
        return sum(begin <= samples for begin in self._begins) - 1

    def move_on(self, samples: float) -> bool:
        """Make new worlds if another stage has begun by ``samples`` control steps; returns whether it has."""
        due = self._due(samples)
        if due == self.stage:
            return False
        self.stage = due
        self.worlds = self._make(self.tasks[due], due)
        return True
