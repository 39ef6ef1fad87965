"""Observations of actor and critic: two tables from name to (size, function), and their histories.

The functions of :data:`POLICY` take :class:`pace.onboard.actor.Signals`: only sensed signals and the robot's estimates
from them, in the environment and in the exported file. Those of :data:`CRITIC` take :class:`TaskState`, the truth. So
the actor cannot see the truth by accident: a privileged name in the policy's list is a configuration error.

Both tables take observations from outside (:mod:`pace.config.plugins`): in the list of names, an entry point or the
import path of an :class:`ActorObservation` or :class:`CriticObservation`. The type decides the group.

A group's observation (N, H * D) is its last H frames of D numbers, oldest first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from itertools import accumulate
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.plugins import CRITIC_OBSERVATIONS, OBSERVATIONS, Registry
from pace.config.task import TaskConfig
from pace.onboard.actor import Signals
from pace.onboard.estimate import columns
from pace.onboard.estimates import ESTIMATES, check
from pace.task.state import TaskState

#: The numbers of an observation, or a function of the robot's number of joints that returns it.
Size = int | Callable[[int], int]


class ActorObservation(NamedTuple):
    """Size and function of one observation of the actor."""

    size: Size
    function: Callable[[Signals], Tensor]


class CriticObservation(NamedTuple):
    """Size and function of one observation of the critic."""

    size: Size
    function: Callable[[TaskState], Tensor]


def per_joint(joints: int) -> int:
    """The size of an observation with one number for each joint."""
    return joints


def _column(values: Tensor) -> Tensor:
    return values.unsqueeze(-1)


#: Sensed, delayed, noisy signals, and quantities computed from them in each control step.
SENSED: dict[str, ActorObservation] = {
    "base_angular_velocity": ActorObservation(3, lambda s: s.sensing.base_angular_velocity),
    "base_position": ActorObservation(3, lambda s: s.sensing.base_position),
    "projected_gravity": ActorObservation(3, lambda s: s.sensing.projected_gravity),
    "joint_position": ActorObservation(per_joint, lambda s: s.sensing.joint_position),
    "joint_velocity": ActorObservation(per_joint, lambda s: s.sensing.joint_velocity),
    "previous_action": ActorObservation(per_joint, lambda s: s.action),
    "ball_position": ActorObservation(3, lambda s: s.sensing.ball_position),
    "base_age": ActorObservation(1, lambda s: _column(s.sensing.base_age)),
    "heading": ActorObservation(2, lambda s: s.sensing.heading),
    "predicted_apex": ActorObservation(3, lambda s: s.apex),
    "predicted_base_shift": ActorObservation(2, lambda s: s.shift),
    "sensed_paddle_to_target": ActorObservation(3, lambda s: s.target - s.paddle_position),
    "sensed_paddle_normal": ActorObservation(3, lambda s: s.paddle_normal),
    "predicted_time": ActorObservation(1, lambda s: _column(s.time)),
    "something_to_hit": ActorObservation(1, lambda s: _column(s.track.something_to_hit)),
}


Observation = TypeVar("Observation", ActorObservation, CriticObservation)


def _only(kind: type[Observation]) -> Callable[[object], Observation]:
    def accept(found: object) -> Observation:
        if isinstance(found, kind):
            return found
        privileged = " (privileged: for the critic alone)" if isinstance(found, CriticObservation) else ""
        raise TypeError(f"must be of type {kind.__name__}, not {type(found).__name__}{privileged}")

    return accept


class PolicyObservations(Registry[ActorObservation]):
    """``SENSED``, the actor's parts of the estimates that ``ESTIMATES`` has now, and others."""

    def __missing__(self, name: str) -> ActorObservation:
        for estimate, entry in ESTIMATES.items():
            if name in entry.observations:
                return _part_of(estimate, entry.observations[name])
        return super().__missing__(name)

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or any(name in entry.observations for entry in ESTIMATES.values())

    def __iter__(self) -> Iterator[str]:
        yield from super().__iter__()
        for entry in ESTIMATES.values():
            yield from entry.observations


def _part_of(estimate: str, part: str) -> ActorObservation:
    @cache
    def where(joints: int) -> slice:
        return columns(ESTIMATES[estimate].make.parts(joints))[part]

    return ActorObservation(
        lambda joints: where(joints).stop - where(joints).start,
        lambda s: s.estimates[estimate][:, where(s.action.shape[1])],
    )


#: The actor's observations: ``SENSED`` and the estimates.
POLICY = PolicyObservations("name", OBSERVATIONS, _only(ActorObservation), SENSED)

#: The critic's observations: the truth.
CRITIC: Registry[CriticObservation] = Registry("name", CRITIC_OBSERVATIONS, _only(CriticObservation))
CRITIC |= {
    "base_angular_velocity": CriticObservation(3, lambda s: s.robot.base_angular_velocity),
    "base_position": CriticObservation(3, lambda s: s.robot.base_position),
    "projected_gravity": CriticObservation(3, lambda s: s.robot.projected_gravity),
    "joint_position": CriticObservation(per_joint, lambda s: s.joint_offset),
    "joint_velocity": CriticObservation(per_joint, lambda s: s.robot.joint_velocity),
    "previous_action": CriticObservation(per_joint, lambda s: s.action),
    "ball_position": CriticObservation(3, lambda s: s.ball.position),
    "heading": CriticObservation(2, lambda s: s.robot.heading),
    "apex": CriticObservation(3, lambda s: s.apex),
    "base_shift": CriticObservation(2, lambda s: s.shift),
    "ball_velocity": CriticObservation(3, lambda s: s.ball.velocity),
    "paddle_position": CriticObservation(3, lambda s: s.robot.paddle_position),
    "time_to_arrival": CriticObservation(1, lambda s: _column(s.arrival)),
    "serve_progress": CriticObservation(1, lambda s: _column(s.serve_progress)),
    "episode_progress": CriticObservation(1, lambda s: _column(s.episode_progress)),
    "own_bounce": CriticObservation(1, lambda s: _column(s.game.referee.own_bounces > 0)),
    "paddle_touched": CriticObservation(1, lambda s: _column(s.game.referee.touched)),
    "base_linear_velocity": CriticObservation(3, lambda s: s.robot.base_linear_velocity),
    "foot_contact": CriticObservation(2, lambda s: s.foot_contact),
    "paddle_to_target": CriticObservation(3, lambda s: s.paddle_to_target),
    "paddle_velocity": CriticObservation(3, lambda s: s.robot.paddle_velocity),
    "paddle_normal": CriticObservation(3, lambda s: s.robot.paddle_normal),
    # of each world: the restitution is that at speed zero
    "paddle_restitution": CriticObservation(1, lambda s: _column(torch.as_tensor(s.ball.params.paddle_restitution))),
    "paddle_friction": CriticObservation(1, lambda s: _column(torch.as_tensor(s.ball.params.paddle_friction))),
    "paddle_tangential_restitution": CriticObservation(
        1, lambda s: _column(torch.as_tensor(s.ball.params.paddle_tangential_restitution))
    ),
    "mocap_delay": CriticObservation(1, lambda s: _column(s.mocap_delay)),
}

Table = Mapping[str, ActorObservation] | Mapping[str, CriticObservation]


def check_policy(config: TaskConfig) -> None:
    """Raise :class:`ConfigError` for a name that is privileged or unknown."""
    names, predictor = config.observation.policy, config.predictor
    _check_names("policy", names, POLICY)
    check(config)
    if "predicted_time" in names and predictor.enabled and "target_time" not in predictor.outputs:
        raise ConfigError("observation.policy has 'predicted_time': add 'target_time' to predictor.outputs")


def check_critic(names: list[str]) -> None:
    """Raise :class:`ConfigError` for an unknown name."""
    _check_names("critic", names, CRITIC)


def _check_names(group: str, names: list[str], table: Table) -> None:
    for name in names:
        if name not in table and name in CRITIC:
            what = "privileged: for the critic alone"
            raise ConfigError(f"observation.{group}: unknown name '{name}' ({what}); known: {', '.join(table)}")
        try:
            table[name]
        except ConfigError as error:
            raise ConfigError(f"observation.{group}: {error}") from error


def layout(names: list[str], table: Table, joints: int) -> dict[str, slice]:
    """Columns of each observation within a frame, of a robot with so many joints."""
    ends = list(accumulate(width(table[name].size, joints) for name in names))
    return {name: slice(start, end) for name, start, end in zip(names, [0, *ends], ends, strict=False)}


def width(size: Size, joints: int) -> int:
    """Numbers of an observation of a robot with so many joints."""
    return size(joints) if callable(size) else size
