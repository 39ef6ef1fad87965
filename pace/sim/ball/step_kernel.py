"""The kernel of :meth:`pace.sim.ball.ball.BallSim.fly`: a control step with events. One thread a world.

It lies alone in its module, as the others of the flight do: they compile side by side (seconds each for a GPU).
"""

import warp as wp

from pace.sim.ball.events import clear_events, record_event
from pace.sim.ball.flight import flight_of, fly_leg
from pace.sim.ball.gaps import gaps_to, reachable_surfaces
from pace.sim.ball.paddle import paddle_centre, paddle_speed_bound
from pace.sim.ball.scene import BODY, NOTHING, Scene, read_body
from pace.sim.ball.state import BallArrays, EventArrays

# Sub-steps after which a control step is given up: only a state that is not finite takes so many.
_MAX_LEGS = wp.constant(1024)


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
    flight = flight_of(ball, world)
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
