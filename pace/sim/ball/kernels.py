"""The kernels of :class:`pace.sim.ball.BallSim`: a control step with events, a forecast, a skipped flight.

One thread a world.
"""

import warp as wp

from pace.sim.ball.flight import (
    FLOOR,
    NET,
    NOTHING,
    PADDLE,
    STATIC_SURFACES,
    TABLE,
    Arc,
    Body,
    Flight,
    Leg,
    Scene,
    arc_position,
    arc_velocity,
    fly_leg,
    gaps_to,
    paddle_centre,
    paddle_pose,
    paddle_speed_bound,
    reachable_surfaces,
    read_body,
)
from pace.sim.ball.state import BallArrays, EventArrays, ForecastArrays

#: s, the forecast looks no further ahead; a ball that rolls on the table would go on for ever.
FORECAST_HORIZON = 3.0
# Sub-steps after which a control step or a forecast is given up: only a state that is not finite takes so many.
_MAX_LEGS = wp.constant(1024)
_MAX_FORECAST_LEGS = wp.constant(8192)
_HORIZON = wp.constant(FORECAST_HORIZON)
_BISECTIONS = wp.constant(20)


@wp.func
def _clear_events(events: EventArrays, world: int):
    zero = wp.vec3(0.0, 0.0, 0.0)
    events.own_bounce[world] = 0
    events.opponent_bounce[world] = 0
    events.paddle_hit[world] = 0
    events.net[world] = 0
    events.floor[world] = 0
    events.edge[world] = 0
    events.own_bounce_time[world] = wp.inf
    events.opponent_bounce_time[world] = wp.inf
    events.paddle_hit_time[world] = wp.inf
    events.net_time[world] = wp.inf
    events.floor_time[world] = wp.inf
    events.edge_time[world] = wp.inf
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
def _clear_forecast(forecast: ForecastArrays, world: int):
    nothing = wp.vec3(wp.nan, wp.nan, wp.nan)
    forecast.bounce[world] = nothing
    forecast.bounce_time[world] = wp.nan
    forecast.bounce_velocity[world] = nothing
    forecast.apex[world] = nothing
    forecast.apex_time[world] = wp.nan
    forecast.intercept[world] = nothing
    forecast.intercept_time[world] = wp.nan
    forecast.intercept_velocity[world] = nothing
    forecast.landing[world] = nothing
    forecast.landing_time[world] = wp.nan
    forecast.landing_own[world] = False
    forecast.landing_opponent[world] = False
    forecast.net_height[world] = wp.nan


@wp.func
def _count(counts: wp.array[wp.int32], times: wp.array[wp.float32], world: int, clock: float):
    if counts[world] == 0:
        times[world] = clock
    counts[world] = counts[world] + 1


@wp.func
def _on_top(leg: Leg) -> bool:
    """A bounce on the playing surface, whose upper edges belong to it."""
    return leg.surface == TABLE and leg.normal[2] > 0.0


@wp.func
def _record_table(events: EventArrays, leg: Leg, clock: float, world: int):
    if not _on_top(leg):
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
def _record_event(events: EventArrays, leg: Leg, after: Flight, body: Body, scene: Scene, world: int):
    """Enter the contact at the end of ``leg`` into the events; ``after`` is the flight behind the impulse."""
    clock = after.clock
    if leg.surface == PADDLE:
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
        else:
            _count(events.floor, events.floor_time, world, clock)


@wp.func
def _flight_of(ball: BallArrays, world: int) -> Flight:
    """The flight that begins with the ball of a world; its gaps are still to be found."""
    flight = Flight()
    flight.position = ball.position[world]
    flight.velocity = ball.velocity[world]
    flight.spin = ball.spin[world]
    return flight


@wp.func
def _segment_distance(start: wp.vec3, end: wp.vec3) -> float:
    """Smallest distance of the origin to the segment from ``start`` to ``end``."""
    way = end - start
    share = -wp.dot(start, way) / wp.max(wp.dot(way, way), 1.0e-12)
    return wp.length(start + wp.clamp(share, 0.0, 1.0) * way)


@wp.kernel
def fly_step(
    ball: BallArrays,
    params: wp.array2d[wp.float32],
    scene: Scene,
    events: EventArrays,
    nearest: wp.array[wp.float32],
    control_dt: float,
    ball_dt: float,
):
    """Fly the ball of each world through one control step along the paddle's path."""
    world = wp.tid()
    _clear_events(events, world)
    body = read_body(params, world)
    flight = _flight_of(ball, world)
    paddle_speed = paddle_speed_bound(scene, world)
    # A rebound turns spin into speed.
    speed = wp.length(flight.velocity) + body.radius * wp.length(flight.spin)
    surfaces = reachable_surfaces(flight.position, speed, paddle_speed, control_dt, body.radius, scene, world)
    flight.gaps = gaps_to(surfaces, flight.position, 0.0, body.radius, scene, world)
    centre = paddle_centre(scene, world, 0.0)
    distance = wp.length(flight.position - centre)
    for _leg in range(_MAX_LEGS):
        remaining = control_dt - flight.clock
        flight, leg = fly_leg(flight, surfaces, paddle_speed, remaining, ball_dt, body, scene, world)
        next_centre = paddle_centre(scene, world, flight.clock)
        distance = wp.min(distance, _segment_distance(leg.arc.start - centre, leg.arc.end - next_centre))
        centre = next_centre
        if leg.surface != NOTHING:
            _record_event(events, leg, flight, body, scene, world)
        if flight.clock >= control_dt * 0.999999:
            break
    ball.position[world] = flight.position
    ball.velocity[world] = flight.velocity
    ball.spin[world] = flight.spin
    nearest[world] = distance


@wp.func
def _passing_time(arc: Arc, level: float, earliest: float) -> float:
    """When x passes ``level`` on an arc, after ``earliest`` s, before which it has not."""
    low = wp.float32(earliest)
    high = wp.float32(arc.duration)
    above = arc_position(arc, low)[0] > level
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if (arc_position(arc, middle)[0] > level) == above:
            low = middle
        else:
            high = middle
    return high


@wp.func
def _apex_time(arc: Arc) -> float:
    """When a rising ball stops rising on an arc; its end, where a contact turns it down."""
    low = wp.float32(0.0)
    high = wp.float32(arc.duration)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if arc_velocity(arc, middle)[2] > 0.0:
            low = middle
        else:
            high = middle
    return high


@wp.func
def _note_net(forecast: ForecastArrays, arc: Arc, world: int):
    if wp.isnan(forecast.net_height[world]) and arc.start[0] < 0.0 and arc.end[0] >= 0.0:
        forecast.net_height[world] = arc_position(arc, _passing_time(arc, 0.0, 0.0))[2]


@wp.func
def _note_intercept(forecast: ForecastArrays, arc: Arc, time: float, world: int):
    forecast.intercept[world] = arc_position(arc, time)
    forecast.intercept_time[world] = arc.clock + time
    forecast.intercept_velocity[world] = arc_velocity(arc, time)


@wp.func
def _note_apex(forecast: ForecastArrays, arc: Arc, after: Flight, intercept_x: float, world: int):
    """Apex and intercept of a leg that comes after the bounce."""
    if arc.duration <= 0.0:
        return
    earliest = wp.float32(0.0)
    if wp.isnan(forecast.apex_time[world]):
        if arc.start_velocity[2] <= 0.0 or after.velocity[2] > 0.0:
            return
        earliest = _apex_time(arc)
        forecast.apex[world] = arc_position(arc, earliest)
        forecast.apex_time[world] = arc.clock + earliest
    if wp.isnan(forecast.intercept_time[world]) and arc.end[0] <= intercept_x:
        if arc_position(arc, earliest)[0] > intercept_x:
            earliest = _passing_time(arc, intercept_x, earliest)
        _note_intercept(forecast, arc, earliest, world)


@wp.func
def _note_contact(forecast: ForecastArrays, leg: Leg, after: Flight, world: int):
    """Bounce and landing of a leg that ends on a surface."""
    on_top = _on_top(leg)
    own = on_top and leg.arc.end[0] < 0.0
    if own and wp.isnan(forecast.bounce_time[world]):
        forecast.bounce[world] = leg.arc.end
        forecast.bounce_time[world] = after.clock
        forecast.bounce_velocity[world] = after.velocity
    if (on_top or leg.surface == FLOOR) and wp.isnan(forecast.landing_time[world]):
        forecast.landing[world] = leg.arc.end
        forecast.landing_time[world] = after.clock
        forecast.landing_own[world] = own
        forecast.landing_opponent[world] = on_top and not own


@wp.kernel
def forecast_flight(
    mask: wp.array[wp.bool],
    ball: BallArrays,
    params: wp.array2d[wp.float32],
    scene: Scene,
    forecast: ForecastArrays,
    intercept_x: float,
    ball_dt: float,
):
    """Fly the ball of each masked world ahead, without a paddle, and note what it meets. The others keep theirs."""
    world = wp.tid()
    if not mask[world]:
        return
    _clear_forecast(forecast, world)
    body = read_body(params, world)
    flight = _flight_of(ball, world)
    flight.gaps = gaps_to(STATIC_SURFACES, flight.position, 0.0, body.radius, scene, world)
    for _leg in range(_MAX_FORECAST_LEGS):
        remaining = _HORIZON - flight.clock
        flight.located = 0
        flight, leg = fly_leg(flight, STATIC_SURFACES, 0.0, remaining, ball_dt, body, scene, world)
        _note_net(forecast, leg.arc, world)
        if not wp.isnan(forecast.bounce_time[world]):
            _note_apex(forecast, leg.arc, flight, intercept_x, world)
        if leg.surface != NOTHING:
            _note_contact(forecast, leg, flight, world)
        known = not (wp.isnan(forecast.landing_time[world]) or wp.isnan(forecast.intercept_time[world]))
        if known or leg.surface == FLOOR or flight.clock >= _HORIZON * 0.999999:
            return


@wp.kernel
def skip_flight(
    mask: wp.array[wp.bool],
    duration: wp.array[wp.float32],
    ball: BallArrays,
    params: wp.array2d[wp.float32],
    scene: Scene,
    ball_dt: float,
):
    """Move the ball of each masked world on by ``duration`` s without a paddle, or to the last sub-step in the air."""
    world = wp.tid()
    if not mask[world]:
        return
    body = read_body(params, world)
    flight = _flight_of(ball, world)
    flight.gaps = gaps_to(STATIC_SURFACES, flight.position, 0.0, body.radius, scene, world)
    for _leg in range(_MAX_FORECAST_LEGS):
        remaining = duration[world] - flight.clock
        if remaining <= 0.0:
            return
        flight, leg = fly_leg(flight, STATIC_SURFACES, 0.0, remaining, ball_dt, body, scene, world)
        if leg.surface != NOTHING:
            return
        ball.position[world] = flight.position
        ball.velocity[world] = flight.velocity
