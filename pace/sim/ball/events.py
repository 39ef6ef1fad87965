"""What the ball met in a control step, entered into :class:`pace.sim.ball.state.BallEvents`, as Warp functions."""

import warp as wp

from pace.sim.ball.flight import Flight, Leg
from pace.sim.ball.paddle import paddle_pose
from pace.sim.ball.robot_body import nearest_shape
from pace.sim.ball.scene import BODY, NET, PADDLE, TABLE, Body, Scene
from pace.sim.ball.state import EventArrays


@wp.func
def clear_events(events: EventArrays, world: int):
    zero = wp.vec3(0.0, 0.0, 0.0)
    events.own_bounce[world] = 0
    events.opponent_bounce[world] = 0
    events.paddle_hit[world] = 0
    events.net[world] = 0
    events.floor[world] = 0
    events.edge[world] = 0
    events.body[world] = 0
    events.own_bounce_time[world] = wp.inf
    events.opponent_bounce_time[world] = wp.inf
    events.paddle_hit_time[world] = wp.inf
    events.net_time[world] = wp.inf
    events.floor_time[world] = wp.inf
    events.edge_time[world] = wp.inf
    events.body_time[world] = wp.inf
    events.hit_point[world] = zero
    events.hit_position[world] = zero
    events.hit_offset[world] = zero
    events.hit_normal[world] = zero
    events.hit_relative_velocity[world] = zero
    events.hit_velocity_in[world] = zero
    events.hit_velocity_out[world] = zero
    events.hit_spin_out[world] = zero
    events.hit_rim[world] = False
    events.paddle_impulse[world] = zero
    events.impulse_point[world] = zero
    events.bounce_position[world] = zero


@wp.func
def _count(counts: wp.array[wp.int32], times: wp.array[wp.float32], world: int, clock: float):
    if counts[world] == 0:
        times[world] = clock
    counts[world] = counts[world] + 1


@wp.func
def on_top(leg: Leg) -> bool:
    """A bounce on the playing surface, whose upper edges belong to it."""
    return leg.surface == TABLE and leg.normal[2] > 0.0


@wp.func
def _record_table(events: EventArrays, leg: Leg, clock: float, world: int):
    if not on_top(leg):
        _count(events.edge, events.edge_time, world, clock)
        return
    if events.own_bounce[world] + events.opponent_bounce[world] == 0:
        events.bounce_position[world] = leg.arc.end
    if leg.arc.end[0] < 0.0:
        _count(events.own_bounce, events.own_bounce_time, world, clock)
    else:
        _count(events.opponent_bounce, events.opponent_bounce_time, world, clock)


@wp.func
def _record_hit(events: EventArrays, leg: Leg, after: Flight, point: wp.vec3, scene: Scene, world: int):
    """The values of the first paddle hit of the step."""
    pose = paddle_pose(scene, world, after.clock)
    offset = leg.arc.end - pose.centre
    events.hit_point[world] = point
    events.hit_position[world] = leg.arc.end
    events.hit_offset[world] = offset
    events.hit_normal[world] = leg.normal
    events.hit_relative_velocity[world] = leg.arc.end_velocity - leg.surface_velocity
    events.hit_velocity_in[world] = leg.arc.end_velocity
    events.hit_velocity_out[world] = after.velocity
    events.hit_spin_out[world] = after.spin
    radial = offset - wp.dot(offset, pose.normal) * pose.normal
    events.hit_rim[world] = wp.length(radial) > scene.paddle_radius


@wp.func
def by_paddle_hand(leg: Leg, clock: float, scene: Scene, world: int) -> bool:
    """Whether the contact is with the hand that holds the paddle."""
    if leg.surface != BODY:
        return False
    nearest = nearest_shape(scene.robot, world, leg.arc.end, clock, scene.path_dt)
    if nearest.shape < 0:  # a ball that is not finite
        return False
    return scene.robot.hand[nearest.shape]


@wp.func
def record_event(events: EventArrays, leg: Leg, after: Flight, body: Body, scene: Scene, world: int):
    """Enter the contact at the end of ``leg`` into the events; ``after`` is the flight behind the impulse.

    The hand that holds the paddle hits as the paddle does.
    """
    clock = after.clock
    if leg.surface == PADDLE or by_paddle_hand(leg, clock, scene, world):
        point = leg.arc.end - body.radius * leg.normal
        change = after.velocity - leg.arc.end_velocity
        events.paddle_impulse[world] = events.paddle_impulse[world] - body.mass * change
        events.impulse_point[world] = point
        if leg.begins:
            if events.paddle_hit[world] == 0:
                _record_hit(events, leg, after, point, scene, world)
            _count(events.paddle_hit, events.paddle_hit_time, world, clock)
    elif leg.begins:
        if leg.surface == TABLE:
            _record_table(events, leg, clock, world)
        elif leg.surface == NET:
            _count(events.net, events.net_time, world, clock)
        elif leg.surface == BODY:
            _count(events.body, events.body_time, world, clock)
        else:
            _count(events.floor, events.floor_time, world, clock)
