"""The kernel of :meth:`pace.sim.ball.ball.BallSim.skipper`: a flight is moved on at once. One thread a world."""

import warp as wp

from pace.sim.ball.flight import flight_of, fly_leg
from pace.sim.ball.gaps import gaps_to
from pace.sim.ball.scene import NOTHING, STATIC_SURFACES, Scene, read_body
from pace.sim.ball.state import BallArrays

# Sub-steps after which a flight is given up: only a state that is not finite takes so many.
_MAX_LEGS = wp.constant(8192)


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
    flight = flight_of(ball, world)
    flight.gaps = gaps_to(STATIC_SURFACES, flight.position, 0.0, body.radius, scene, world)
    for _leg in range(_MAX_LEGS):
        remaining = duration[world] - flight.clock
        if remaining <= 0.0:
            return
        flight, leg = fly_leg(flight, STATIC_SURFACES, 0.0, remaining, ball_dt, body, scene, world)
        if leg.surface != NOTHING:
            return
        ball.position[world] = flight.position
        ball.velocity[world] = flight.velocity
