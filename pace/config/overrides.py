"""Changing the task saved with a policy or a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pace.config.base import ConfigError, compose, parse, to_dict
from pace.config.names import check_choice, check_renamed
from pace.config.schedules import END, Position, begin_in_words
from pace.config.training import TrainConfig

#: Groups of configs/ whose choice may change for a saved policy; networks and observations may not.
TASK_GROUPS = ("ball", "serve", "reset", "randomization", "sensing", "reward", "robot")
#: Of the engine, what a robot needs: limits of the solver, which ends at convergence. They come with its choice.
SOLVER = ("solver_iterations", "line_search_iterations")
#: Parts of a saved task in which single values may change.
TASK_VALUES = ("landing_target",)
CHANGEABLE = (*TASK_GROUPS, "engine", *TASK_VALUES)


#: Changes of a saved task for one world or a few on a CPU, whatever it was trained on.
ON_A_CPU = ("engine=native", "engine.threads=1", "engine.graph=auto")


def stage_tasks(config: TrainConfig, at: Position = END) -> list[TrainConfig]:
    """``config``, then each stage of its curriculum that is reached ``at`` a place, applied to the one before.

    Errors: :class:`ConfigError`, which names the stage, for a change of an unknown key.
    """
    tasks = [config]
    for stage in config.curriculum:
        if not stage.reached(at):
            break
        try:
            tasks.append(override_task(tasks[-1], stage.task))
        except ConfigError as error:
            raise ConfigError(f"curriculum, from {begin_in_words(stage)} on: {error}") from error
    return tasks


def override_task(config: TrainConfig, overrides: Sequence[str]) -> TrainConfig:
    """A saved configuration with parts of its task changed; ``config`` is not changed.

    An override is a choice of a group, ``ball=paper`` (of :data:`TASK_GROUPS`; ``engine=native`` keeps the saved
    solver, ``robot=t1`` brings its limits), or a value, ``engine.physics_dt=0.002``. Choices are applied before
    values, later ones win.

    Errors: :class:`ConfigError` for anything else, and for unknown keys and values.
    """
    check_renamed(overrides)
    choices: dict[str, str] = {}
    values: list[str] = []
    for override in overrides:
        key, equals, choice = override.partition("=")
        if not equals:
            raise ConfigError(f"override '{override}' is not of the form key=value")
        if key in TASK_GROUPS:
            choices[key] = choice
        elif key == "engine":
            values.append(f"engine.name={choice}")
        elif key.split(".")[0] in CHANGEABLE:
            values.append(override)
        else:
            raise ConfigError(f"'{key}' cannot change for a saved policy; {', '.join(TASK_GROUPS)} and engine can")
    merged: dict[str, Any] = _choose(to_dict(config), choices)
    try:
        changed = OmegaConf.merge(OmegaConf.create(merged), OmegaConf.from_dotlist(values))
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).split("\n")[0]) from error
    return parse(OmegaConf.to_container(changed), TrainConfig)  # type: ignore[arg-type]


def without_reward(config: TrainConfig) -> TrainConfig:
    """The same task to roll out a policy: its reward has no terms, so that none has to be known."""
    return replace(config, reward=replace(config.reward, terms={}))


def _choose(saved: Mapping[str, Any], choices: Mapping[str, str]) -> dict[str, Any]:
    """``saved`` with the choice of each group, from configs/."""
    if not choices:
        return dict(saved)
    for group, choice in choices.items():
        check_choice(group, choice)
    try:
        fresh = compose("train", [f"{group}={choice}" for group, choice in choices.items()])
    except HydraException as error:
        raise ConfigError(" ".join(str(error).split())) from error
    chosen = {**saved, **{group: fresh[group] for group in choices}}
    if "robot" in choices:
        chosen["engine"] = {**saved["engine"], **{name: fresh["engine"][name] for name in SOLVER}}
    return chosen
