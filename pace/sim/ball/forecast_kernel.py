"""The kernel of :meth:`pace.sim.ball.ball.BallSim.forecast`: a flight ahead without a robot. One thread a world."""

import warp as wp

from pace.sim.ball.flight import flight_of, fly_leg
from pace.sim.ball.forecast_notes import clear_forecast, note_apex, note_contact, note_net
from pace.sim.ball.gaps import gaps_to
from pace.sim.ball.scene import FLOOR, NOTHING, STATIC_SURFACES, Scene, read_body
from pace.sim.ball.state import BallArrays, ForecastArrays

#: s; the forecast ends there, because a ball may roll on the table without end.
FORECAST_HORIZON = 3.0
_HORIZON = wp.constant(FORECAST_HORIZON)
# Sub-steps after which a forecast is given up: only a state that is not finite takes so many.
_MAX_LEGS = wp.constant(8192)


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
    flight = flight_of(ball, world)
    flight.gaps = gaps_to(STATIC_SURFACES, flight.position, 0.0, body.radius, scene, world)
    for _leg in range(_MAX_LEGS):
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
