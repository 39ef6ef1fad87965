"""Beginnings and ends of serves as Warp kernels, one thread a world. See :mod:`pace.task.game`."""

import warp as wp

from pace.sim.ball.state import BallArrays, EventArrays, ForecastArrays
from pace.task.game_state import GameArrays
from pace.task.outcome import Outcome
from pace.task.rules import Rules, landed, something_to_hit_now


@wp.func
def _take_return(game: GameArrays, forecast: ForecastArrays, world: int):
    """Keep the forecast of a ball that was just hit."""
    game.returns.landing[world] = forecast.landing[world]
    game.returns.net_height[world] = forecast.net_height[world]
    game.returns.lands_own[world] = forecast.landing_own[world]
    game.returns.lands_opponent[world] = forecast.landing_opponent[world]


@wp.func
def _approach(game: GameArrays, world: int, distance: float):
    """Smallest distance while the ball can be hit legally, and whether it has now been hit or come to its target."""
    hit_now = game.referee.hit_now[world]
    in_play = (
        game.referee.was_open[world]
        and game.referee.own_bounces[world] >= 1
        and (hit_now or not game.referee.touched[world])
    )
    nearest = game.closeness.nearest[world]
    game.closeness.previous[world] = nearest
    if in_play:
        game.closeness.nearest[world] = wp.min(nearest, distance)
    due = hit_now or game.clock.time[world] >= game.target.time[world]
    arrived_now = in_play and due and not game.closeness.arrived[world]
    game.closeness.arrived_now[world] = arrived_now
    if arrived_now:
        game.closeness.arrived[world] = True


@wp.func
def _lost(base: wp.vec3, rules: Rules) -> bool:
    """The robot has fallen or left its area."""
    outside_x = base[0] < rules.bounds_x[0] or base[0] > rules.bounds_x[1]
    outside_y = base[1] < rules.bounds_y[0] or base[1] > rules.bounds_y[1]
    return outside_x or outside_y or base[2] < rules.min_base_height


@wp.func
def _over(game: GameArrays, rules: Rules, world: int, height: float, on_floor: bool) -> bool:
    """The serve ends: ball low or on the floor, time up, or long enough after the contact."""
    time = game.clock.time[world]
    late = rules.end_after_hit > 0.0 and time >= game.referee.touch_time[world] + rules.end_after_hit
    return height < rules.end_height or on_floor or time >= rules.max_duration or late


@wp.func
def _decide(game: GameArrays, world: int, lost: bool, over: bool) -> int:
    """Outcome at the end of a step, in which an open serve may end; a ball in flight is decided by its forecast."""
    if game.referee.outcome[world] != Outcome.OPEN or not (lost or over):
        return game.referee.outcome[world]
    if lost:
        return Outcome.FALL
    if not game.referee.hit[world]:
        return Outcome.MISS
    returns = game.returns
    net_touched = game.referee.net_touched[world]
    return landed(returns.lands_opponent[world], returns.lands_own[world], net_touched, returns.landing[world][0])


@wp.kernel
def close(
    game: GameArrays,
    events: EventArrays,
    forecast: ForecastArrays,
    ball: BallArrays,
    paddle_distance: wp.array[wp.float32],
    radius: wp.array[wp.float32],
    base_position: wp.array[wp.vec3],
    rules: Rules,
):
    """After :func:`judge`: clock, forecast of a hit, approach of the paddle, ends of serves and episodes.

    In a pause no serve is on: none ends, and its clock rests.
    """
    world = wp.tid()
    waiting = game.pause.waiting[world]
    if not waiting:
        game.clock.time[world] += rules.control_dt
    if game.referee.hit_now[world]:
        _take_return(game, forecast, world)
    _approach(game, world, paddle_distance[world] - radius[world])
    lost = _lost(base_position[world], rules)
    over = not waiting and _over(game, rules, world, ball.position[world][2], events.floor[world] > 0)
    outcome = _decide(game, world, lost, over)
    game.referee.outcome[world] = outcome
    game.referee.success_now[world] = game.referee.was_open[world] and outcome == Outcome.SUCCESS
    game.ends.lost[world] = lost
    game.ends.over[world] = over or (lost and not waiting)
    game.ends.next_serve[world] = over and not lost
    last = rules.serves_per_episode > 0 and game.clock.index[world] + 1.0 >= float(rules.serves_per_episode)
    game.ends.truncated[world] = over and last and not lost
    game.ends.outcome[world] = outcome
    game.ends.hit[world] = game.referee.hit[world]
    game.target.something_to_hit[world] = something_to_hit_now(game, ball, rules, world)


@wp.func
def _clamp_x(point: wp.vec3, largest: float) -> wp.vec3:
    """The point with its x at most ``largest``."""
    return wp.vec3(wp.min(point[0], largest), point[1], point[2])


@wp.func
def _aim(game: GameArrays, forecast: ForecastArrays, rules: Rules, world: int):
    """Target of the serve that was forecast; the point to stand by where it cannot be played."""
    playable = not (wp.isnan(forecast.bounce_time[world]) or wp.isnan(forecast.apex_time[world]))
    apex = rules.idle_point
    time = 0.0
    if playable:
        apex = forecast.apex[world]
        time = forecast.apex_time[world]
    game.target.playable[world] = playable
    game.target.apex[world] = apex
    game.target.apex_time[world] = time
    if rules.intercept == 0:
        game.target.point[world] = _clamp_x(apex, rules.target_x)
    elif playable and not wp.isnan(forecast.intercept_time[world]):
        game.target.point[world] = forecast.intercept[world]
        time = forecast.intercept_time[world]
    else:
        game.target.point[world] = apex
    game.target.time[world] = time


@wp.kernel
def start_serve(
    mask: wp.array[wp.bool],
    game: GameArrays,
    forecast: ForecastArrays,
    ball: BallArrays,
    rules: Rules,
):
    """Begin the serve whose flight was forecast, in the masked worlds."""
    world = wp.tid()
    if not mask[world]:
        return
    _aim(game, forecast, rules, world)
    game.target.arriving[world] = wp.vec3(0.0)
    if game.target.playable[world] and not wp.isnan(forecast.intercept_time[world]):
        game.target.arriving[world] = forecast.intercept_velocity[world]
    outcome = int(Outcome.BAD_SERVE)
    if game.target.playable[world]:
        outcome = Outcome.OPEN
    game.referee.outcome[world] = outcome
    game.clock.time[world] = 0.0
    game.referee.own_bounces[world] = 0
    game.referee.hit[world] = False
    game.referee.touched[world] = False
    game.referee.rim[world] = False
    game.referee.net_touched[world] = False
    game.referee.touch_time[world] = wp.inf
    game.closeness.nearest[world] = wp.inf
    game.closeness.previous[world] = wp.inf
    game.closeness.arrived[world] = False
    game.target.something_to_hit[world] = something_to_hit_now(game, ball, rules, world)


@wp.kernel
def start_episode(
    mask: wp.array[wp.bool],
    seed: wp.array[wp.int32],
    serves: int,
    fresh: wp.array[wp.bool],
    index: wp.array[wp.float32],
):
    """First serve of an episode, in the masked worlds: any of ``serves`` where the world is fresh."""
    world = wp.tid()
    if not mask[world]:
        return
    first = 0.0
    if fresh[world] and serves > 0:
        random = wp.rand_init(seed[0], world)
        first = wp.min(wp.floor(wp.randf(random) * float(serves)), float(serves - 1))
    index[world] = first
    fresh[world] = False
