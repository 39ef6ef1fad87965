"""What a ball will meet, entered into :class:`pace.sim.ball.state.Forecast`, as Warp functions."""

import warp as wp

from pace.sim.ball.arc import Arc, arc_position, arc_velocity
from pace.sim.ball.events import on_top
from pace.sim.ball.flight import Flight, Leg
from pace.sim.ball.scene import FLOOR, NET
from pace.sim.ball.state import ForecastArrays

_BISECTIONS = wp.constant(20)


@wp.func
def clear_forecast(forecast: ForecastArrays, world: int):
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
    forecast.net_touched[world] = False


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
def note_net(forecast: ForecastArrays, arc: Arc, world: int):
    if wp.isnan(forecast.net_height[world]) and arc.start[0] < 0.0 and arc.end[0] >= 0.0:
        forecast.net_height[world] = arc_position(arc, _passing_time(arc, 0.0, 0.0))[2]


@wp.func
def _note_intercept(forecast: ForecastArrays, arc: Arc, time: float, world: int):
    forecast.intercept[world] = arc_position(arc, time)
    forecast.intercept_time[world] = arc.clock + time
    forecast.intercept_velocity[world] = arc_velocity(arc, time)


@wp.func
def note_apex(forecast: ForecastArrays, arc: Arc, after: Flight, intercept_x: float, world: int):
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
def note_contact(forecast: ForecastArrays, leg: Leg, after: Flight, world: int):
    """Bounce, landing and a touch of the net before it, of a leg that ends on a surface."""
    if leg.surface == NET and wp.isnan(forecast.landing_time[world]):
        forecast.net_touched[world] = True
    top = on_top(leg)
    own = top and leg.arc.end[0] < 0.0
    if own and wp.isnan(forecast.bounce_time[world]):
        forecast.bounce[world] = leg.arc.end
        forecast.bounce_time[world] = after.clock
        forecast.bounce_velocity[world] = after.velocity
    if (top or leg.surface == FLOOR) and wp.isnan(forecast.landing_time[world]):
        forecast.landing[world] = leg.arc.end
        forecast.landing_time[world] = after.clock
        forecast.landing_own[world] = own
        forecast.landing_opponent[world] = top and not own
