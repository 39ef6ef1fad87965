"""State, events and forecast of the ball: tensors of N worlds, and the kernels' structs of them."""

from __future__ import annotations

from dataclasses import dataclass

from pace.arrays.tensors import Bool, InfFloat, Int, NanFloat, NanVec3, Vec3, struct_of


@dataclass(eq=False)
class BallState:
    """The ball of N worlds."""

    position: Vec3  # m
    velocity: Vec3  # m/s
    spin: Vec3  # rad/s


@struct_of(BallState)
class BallArrays:
    """:class:`BallState` in the kernels' form."""


@dataclass(frozen=True)
class BallEvents:
    """Contacts of the ball in the last control step; every flight overwrites all of them.

    Counts are of contacts that begin; a rolling or resting ball counts once. The rims of the table's top belong to the
    top (ITTF 2.1.5); its sides and underside count as ``edge``. ``body`` is the robot's body, arms, legs and head; the
    hand that holds the paddle, below the wrist, counts as the paddle (ITTF 2.5.7). Times are s into the control step,
    of the first contact of that kind, infinite if there is none. The ``hit`` values belong to the first paddle hit and
    are zero without one.
    """

    own_bounce: Int
    opponent_bounce: Int
    paddle_hit: Int
    net: Int
    floor: Int
    edge: Int
    body: Int
    own_bounce_time: InfFloat  # s
    opponent_bounce_time: InfFloat  # s
    paddle_hit_time: InfFloat  # s
    net_time: InfFloat  # s
    floor_time: InfFloat  # s
    edge_time: InfFloat  # s
    body_time: InfFloat  # s
    hit_point: Vec3  # m, contact point of ball and paddle
    hit_position: Vec3  # m, ball's centre
    hit_offset: Vec3  # m, ball's centre minus paddle's centre
    hit_normal: Vec3  # unit vector from the paddle to the ball
    hit_relative_velocity: Vec3  # m/s, ball's centre minus the paddle's point, before the impact
    hit_velocity_in: Vec3  # m/s
    hit_velocity_out: Vec3  # m/s
    hit_spin_out: Vec3  # rad/s
    hit_rim: Bool  # the rim or its edge rather than a face; also the hand that holds the paddle
    paddle_impulse: Vec3  # N s on the paddle, sum over the step
    impulse_point: Vec3  # m, contact point of the last impulse
    bounce_position: Vec3  # m, ball's centre at the step's first bounce on the table's top


@struct_of(BallEvents)
class EventArrays:
    """:class:`BallEvents` in the kernels' form."""


@dataclass(frozen=True)
class Forecast:
    """A flight ahead without a robot: tensors (N, ...), float32, s and m from now on, NaN if an event does not occur.

    ``bounce`` is the first on the own half, ``apex`` the first highest point after it, and ``intercept`` the later of
    the apex and the passing of x = intercept_x. ``landing`` is the first contact with the table's top or the floor.
    Positions are of the ball's centre. The forecast ends on the floor, or after :data:`FORECAST_HORIZON`.
    """

    bounce: NanVec3  # m
    bounce_time: NanFloat  # s
    bounce_velocity: NanVec3  # m/s, after the bounce
    apex: NanVec3  # m
    apex_time: NanFloat  # s
    intercept: NanVec3  # m
    intercept_time: NanFloat  # s
    intercept_velocity: NanVec3  # m/s
    landing: NanVec3  # m
    landing_time: NanFloat  # s
    landing_own: Bool  # the landing is on the own half of the table
    landing_opponent: Bool  # the landing is on the opponent's half
    net_height: NanFloat  # m, z of the ball when it first passes x = 0 towards the opponent
    net_touched: Bool  # before the landing


@struct_of(Forecast)
class ForecastArrays:
    """:class:`Forecast` in the kernels' form."""
