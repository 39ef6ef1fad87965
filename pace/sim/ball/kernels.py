"""The kernels of :class:`pace.sim.ball.BallSim`: a control step with events, a forecast, a skipped flight.

One thread a world.
"""

import warp as wp

from pace.sim.ball.events import clear_events, record_event
from pace.sim.ball.flight import Flight, fly_leg
from pace.sim.ball.forecast_notes import clear_forecast, note_apex, note_contact, note_net
from pace.sim.ball.gaps import gaps_to, reachable_surfaces
from pace.sim.ball.paddle import paddle_centre, paddle_speed_bound
from pace.sim.ball.scene import BODY, FLOOR, NOTHING, STATIC_SURFACES, Scene, read_body
from pace.sim.ball.state import BallArrays, EventArrays, ForecastArrays

#: s; the forecast ends there, because a ball may roll on the table without end.
FORECAST_HORIZON = 3.0
# Sub-steps after which a control step or a forecast is given up: only a state that is not finite takes so many.
_MAX_LEGS = wp.constant(1024)
_MAX_FORECAST_LEGS = wp.constant(8192)
_HORIZON = wp.constant(FORECAST_HORIZON)


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
    """Fly the ball of each world through one control step along the paths of paddle and body."""
    world = wp.tid()
    clear_events(events, world)
    body = read_body(params, world)
    flight = _flight_of(ball, world)
    paddle_speed = paddle_speed_bound(scene, world)
    robot_speed = wp.float32(paddle_speed)
    # A rebound turns spin into speed.
    speed = wp.length(flight.velocity) + body.radius * wp.length(flight.spin)
    surfaces = reachable_surfaces(flight.position, speed, paddle_speed, control_dt, body.radius, scene, world)
    if surfaces > BODY:
        robot_speed = wp.max(paddle_speed, scene.robot.speed[world])
    flight.gaps = gaps_to(surfaces, flight.position, 0.0, body.radius, scene, world)
    centre = paddle_centre(scene, world, 0.0)
    distance = wp.length(flight.position - centre)
    for _leg in range(_MAX_LEGS):
        remaining = control_dt - flight.clock
        flight, leg = fly_leg(flight, surfaces, robot_speed, remaining, ball_dt, body, scene, world)
        next_centre = paddle_centre(scene, world, flight.clock)
        distance = wp.min(distance, _segment_distance(leg.arc.start - centre, leg.arc.end - next_centre))
        centre = next_centre
        if leg.surface != NOTHING:
            record_event(events, leg, flight, body, scene, world)
        if flight.clock >= control_dt * 0.999999:
            break
    ball.position[world] = flight.position
    ball.velocity[world] = flight.velocity
    ball.spin[world] = flight.spin
    nearest[world] = distance


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
    """Fly the ball of each masked world ahead, without a robot, and note what it meets. The others keep theirs."""
    world = wp.tid()
    if not mask[world]:
        return
    clear_forecast(forecast, world)
    body = read_body(params, world)
    flight = _flight_of(ball, world)
    flight.gaps = gaps_to(STATIC_SURFACES, flight.position, 0.0, body.radius, scene, world)
    for _leg in range(_MAX_FORECAST_LEGS):
        remaining = _HORIZON - flight.clock
        flight.located = 0
        flight, leg = fly_leg(flight, STATIC_SURFACES, 0.0, remaining, ball_dt, body, scene, world)
        note_net(forecast, leg.arc, world)
        if not wp.isnan(forecast.bounce_time[world]):
            note_apex(forecast, leg.arc, flight, intercept_x, world)
        if leg.surface != NOTHING:
            note_contact(forecast, leg, flight, world)
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
    """Move the ball of each masked world on by ``duration`` s without a robot, or to the last sub-step in the air."""
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
