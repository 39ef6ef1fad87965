"""State of the rules in N worlds: the parts of a :class:`pace.task.game.Game`, and the kernels' struct of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pace.arrays.tensors import Bool, Float, InfFloat, Int, NanFloat, NanVec3, Start, Vec3, struct_of
from pace.task.outcome import Outcome


@dataclass(eq=False)
class ServeClock:
    """Counts serves and their time."""

    time: Float  # s since the serve began
    index: Float  # number of the serve in its episode
    played: Float  # serves finished since the world was made
    fresh: Annotated[Bool, Start(True)]  # the world has not been reset yet


@dataclass(eq=False)
class Referee:
    """The referee's state of each serve.

    A hit is physical contact after exactly one bounce on the own half; a valid return then lands first on the
    opponent's half (it may touch the net on the way). A decided outcome does not change until the next serve.
    Only the first event of each kind within a control step has a time. Later ones are assumed to follow the contact at
    once, which is exact unless a ball meets the table twice and the paddle within 20 ms.
    """

    own_bounces: Int
    outcome: Annotated[Int, Start(Outcome.BAD_SERVE)]  # :class:`Outcome`
    touch_time: InfFloat  # s on the serve clock, of the first paddle contact
    hit: Bool  # legal
    touched: Bool  # any paddle contact
    rim: Bool  # the hit was with the rim
    net_touched: Bool  # after the hit
    was_open: Bool  # before the last step
    hit_now: Bool  # in the last step
    success_now: Bool  # in the last step


@dataclass(eq=False)
class Target:
    """Position and time for the paddle to meet the ball, from the forecast of the serve. World frame, serve clock."""

    playable: Bool
    something_to_hit: Bool  # the ball can still be hit legally
    apex: Vec3  # m
    point: Vec3  # m, the paddle's target
    arriving: Vec3  # m/s, the ball's velocity at the later of the apex and ``reward.target_x``
    apex_time: Float  # s
    time: Float  # s, when the ball is at ``point``


@dataclass(eq=False)
class ReturnForecast:
    """Forecast of the flight after a hit, kept until the next one; NaN if there is none."""

    landing: NanVec3  # m, first contact with table or floor
    net_height: NanFloat  # m above the floor when it crosses the net towards +x
    lands_own: Bool
    lands_opponent: Bool


@dataclass(eq=False)
class Closeness:
    """Smallest distance of paddle and ball while the ball could be hit legally, over each serve."""

    nearest: InfFloat  # m, smallest distance from the face centre to the ball's surface so far
    previous: InfFloat  # m, the same a control step ago
    arrived: Bool  # the ball was hit or is past its target time
    arrived_now: Bool  # since this step


@dataclass(eq=False)
class Pause:
    """Between the end of a ball and the next serve (:mod:`pace.task.pauses`)."""

    waiting: Bool  # a pause is on
    left: Float  # s until the next serve
    kind: Int  # what becomes of the ball, :class:`pace.task.pauses.PauseBall`
    carried: Vec3  # m, where a carried ball is


@dataclass(eq=False)
class StepEnds:
    """Serves and episodes that ended in the last control step."""

    lost: Bool  # the robot fell or left its area
    over: Bool  # the serve ended
    next_serve: Bool  # another one begins: at once, or after a pause
    truncated: Bool  # it was the episode's last
    hit: Bool  # of the current serve, also after the next one has begun
    outcome: Int  # the same


@dataclass(eq=False)
class GameState:
    """All of them."""

    clock: ServeClock
    referee: Referee
    target: Target
    returns: ReturnForecast
    closeness: Closeness
    pause: Pause
    ends: StepEnds


@struct_of(GameState)
class GameArrays:
    """:class:`GameState` in the kernels' form."""
