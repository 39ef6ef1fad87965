"""The table of estimates, which environment, exported file and checkpoint iterate.

To add an estimate, write a subclass of :class:`pace.onboard.estimate.Estimate` and a dataclass of its numbers, and
register both, from your package or here::

    ESTIMATES["tilt"] = Entry("tilt", TiltConfig, TiltEstimate, ("projected_gravity",), {"estimated_tilt": "tilt"})

``estimated_tilt`` is then an observation of the actor like any other. Its numbers are in YAML under
``observation.estimates.tilt`` and are checked against the dataclass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pace.config.base import ConfigError, parse
from pace.config.task import (
    AttitudeEstimateConfig,
    DelayEstimateConfig,
    JointEstimateConfig,
    ObservationConfig,
    ReturnMemoryConfig,
    RubberMemoryConfig,
    TaskConfig,
)
from pace.onboard import returns
from pace.onboard.attitude import AttitudeEstimate
from pace.onboard.delay import DelayEstimate
from pace.onboard.estimate import Estimate
from pace.onboard.joints import JointEstimate
from pace.onboard.returns import ReturnMemory
from pace.onboard.rubber import RubberMemory


@dataclass(frozen=True)
class Entry:
    """One estimate.

    Attributes: ``numbers``, key of its numbers in the observation's configuration
    (:meth:`pace.config.task.ObservationConfig.numbers`); ``config``, their dataclass; ``make``, the module's class;
    ``reads``, its input signals: readings by their names (:class:`pace.onboard.actor.Readings`), ``action``,
    ``track`` (N, 3 * frames), ``turned`` (N,), ``something_to_hit`` (N,), ``paddle_position``, ``paddle_normal``,
    ``apex``, ``target``, ``time``; ``observations``, name of an observation of the actor -> part of the state;
    ``replaces``, reading -> part that replaces it in computing the paddle's pose. Such an estimate runs before
    the paddle's pose and the prediction, and may read readings and ``action`` alone. ``frames``: number of
    the ball's positions that it needs.
    """

    numbers: str
    config: type
    make: type[Estimate]
    reads: tuple[str, ...]
    observations: Mapping[str, str]
    replaces: Mapping[str, str] = field(default_factory=dict)
    frames: int = 0


_RETURNS = ("track", "turned", "paddle_position", "paddle_normal")
_TURNS = ("base_angular_velocity", "projected_gravity", "heading")

#: Name of each estimate, as in checkpoints and in the exported file's state -> its entry.
ESTIMATES: dict[str, Entry] = {
    "memory": Entry(
        "return_memory",
        ReturnMemoryConfig,
        ReturnMemory,
        _RETURNS,
        {"last_return": "last_return"},
        frames=returns.FRAMES,
    ),
    "rubber": Entry(
        "rubber_memory",
        RubberMemoryConfig,
        RubberMemory,
        _RETURNS,
        {"last_rubber": "last_rubber"},
        frames=returns.FRAMES,
    ),
    "delay": Entry("delay_estimate", DelayEstimateConfig, DelayEstimate, _TURNS, {"sensed_delay": "delay"}),
    "attitude": Entry(
        "attitude_estimate",
        AttitudeEstimateConfig,
        AttitudeEstimate,
        _TURNS,
        {"estimated_gravity": "gravity", "estimated_heading": "heading"},
        replaces={"projected_gravity": "gravity", "heading": "heading"},
    ),
    "joints": Entry(
        "joint_estimate",
        JointEstimateConfig,
        JointEstimate,
        ("joint_position", "joint_velocity"),
        {"estimated_joint_position": "position", "estimated_joint_velocity": "velocity"},
        replaces={"joint_position": "position"},
    ),
}


def observed(observation: ObservationConfig) -> dict[str, Entry]:
    """The estimates that the policy observes, by name; only these are computed."""
    seen = set(observation.policy)
    return {name: entry for name, entry in ESTIMATES.items() if seen.intersection(entry.observations)}


def make_estimates(config: TaskConfig, joints: int) -> dict[str, Estimate]:
    """The modules of :func:`observed`, by name, for a robot with so many joints. Errors: those of :func:`check`."""
    check(config)
    chosen = observed(config.observation)
    return {
        name: entry.make(numbers(config.observation, name), config.robot.control_dt, joints)  # type: ignore[arg-type]
        for name, entry in chosen.items()
    }


def numbers(observation: ObservationConfig, name: str) -> Any:
    """The numbers of an estimate, an instance of its dataclass; ``None`` if none are given.

    Errors: :class:`ConfigError` for numbers that do not fit the dataclass.
    """
    entry = ESTIMATES[name]
    given = observation.numbers().get(entry.numbers)
    if given is None or isinstance(given, entry.config):
        return given
    try:
        return parse(given, entry.config)
    except ConfigError as error:
        raise ConfigError(f"observation.estimates.{entry.numbers}: {error}") from error


def check(config: TaskConfig) -> None:
    """Raise :class:`ConfigError` for an observed estimate without its numbers, for wrong ones, and for unknown keys."""
    observation = config.observation
    for name, entry in observed(observation).items():
        asked = next(seen for seen in observation.policy if seen in entry.observations)
        if numbers(observation, name) is None:
            own = entry.numbers in observation.built_in()
            where = f"{entry.numbers} (observation=memory)" if own else f"estimates.{entry.numbers}"
            raise ConfigError(f"observation.policy has '{asked}': give observation.{where}")
        if config.predictor.frames < entry.frames:
            raise ConfigError(
                f"observation '{asked}' needs predictor.frames of {entry.frames} or more, got {config.predictor.frames}"
            )
    known = [entry.numbers for entry in ESTIMATES.values()]
    unknown = [key for key in observation.estimates if key not in known]
    if unknown:
        raise ConfigError(f"observation.estimates: nobody registered '{unknown[0]}'; known: {', '.join(known)}")
