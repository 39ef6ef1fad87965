"""The rules of a serve as Warp kernels, one thread a world. See :mod:`pace.task.game`."""

import warp as wp

from pace.sim.ball.state import BallArrays, EventArrays, ForecastArrays
from pace.task.game_state import GameArrays
from pace.task.outcome import Outcome

OPEN = wp.constant(int(Outcome.OPEN))
SUCCESS = wp.constant(int(Outcome.SUCCESS))
MISS = wp.constant(int(Outcome.MISS))
NET = wp.constant(int(Outcome.NET))
OUT = wp.constant(int(Outcome.OUT))
OWN_SIDE = wp.constant(int(Outcome.OWN_SIDE))
DOUBLE_HIT = wp.constant(int(Outcome.DOUBLE_HIT))
VOLLEY = wp.constant(int(Outcome.VOLLEY))
FALL = wp.constant(int(Outcome.FALL))
BAD_SERVE = wp.constant(int(Outcome.BAD_SERVE))


@wp.struct
class Rules:
    """Numbers of the configuration that the kernels need; m, s, world frame."""

    control_dt: float
    max_duration: float
    end_after_hit: float  # 0: off
    end_height: float
    serves_per_episode: int  # 0: no end
    min_base_height: float
    bounds_x: wp.vec2
    bounds_y: wp.vec2
    intercept: int  # target: 1 the later of apex and x = target_x, 0 the apex with its x clamped
    target_x: float
    arm_offset: wp.vec2
    idle_point: wp.vec3
    idle_base: wp.vec2
    past_x: float
    low_z: float
    falling_x: float


@wp.func
def nothing_to_hit(position: wp.vec3, velocity: wp.vec3, rules: Rules) -> bool:
    """A ball that is past the robot, moves away, is too low, or falls behind the table cannot be hit any more."""
    gone = position[0] < rules.past_x or velocity[0] > 0.0 or position[2] < rules.low_z
    return gone or (position[0] < rules.falling_x and velocity[2] < 0.0)


@wp.func
def clamp_x(point: wp.vec3, largest: float) -> wp.vec3:
    """The point with its x at most ``largest``."""
    return wp.vec3(wp.min(point[0], largest), point[1], point[2])


@wp.func
def something_to_hit_now(game: GameArrays, ball: BallArrays, rules: Rules, world: int) -> bool:
    undecided = game.referee.outcome[world] == OPEN and not game.referee.touched[world]
    return undecided and not nothing_to_hit(ball.position[world], ball.velocity[world], rules)


@wp.func
def _landed(opponent: bool, own: bool, net_touched: bool, x: float) -> int:
    """Outcome of a hit ball by where it lands first; off the table it is out, or caught by the net."""
    if opponent:
        return SUCCESS
    if net_touched and (own or x < 0.0):
        return NET
    if own:
        return OWN_SIDE
    return OUT


@wp.func
def _after(time: float, since: float) -> float:
    if time > since:
        return time
    return wp.inf


@wp.func
def _judge_flight(
    game: GameArrays, events: EventArrays, world: int, since: float, own_count: int, touches: int, dead: float, x: float
) -> int:
    """Outcome of a ball in flight after a legal hit, from what it met after ``since`` (s into the step)."""
    opponent = _after(events.opponent_bounce_time[world], since)
    off_table = _after(dead, since)
    own = wp.float32(wp.inf)
    if own_count > 0:
        own = wp.max(events.own_bounce_time[world], since)
    again = wp.float32(wp.inf)
    if touches > 0:
        again = wp.max(events.paddle_hit_time[world], since)
    first = wp.min(wp.min(opponent, off_table), wp.min(own, again))
    net = _after(events.net_time[world], since)
    if net < wp.inf and net <= first:
        game.referee.net_touched[world] = True
    if first == wp.inf:
        return OPEN
    if again == first and opponent > first and own > first:
        return DOUBLE_HIT
    return _landed(opponent == first, own == first, game.referee.net_touched[world], x)


@wp.kernel
def judge(game: GameArrays, events: EventArrays, ball: BallArrays):
    """The referee: consume the events of one control step in the order of their times."""
    world = wp.tid()
    was_open = game.referee.outcome[world] == OPEN
    hit_before = game.referee.hit[world]
    touch = events.paddle_hit_time[world]
    struck = events.paddle_hit[world] > 0
    bounce_first = events.own_bounce_time[world] < touch
    before = game.referee.own_bounces[world]
    if not struck:
        before += events.own_bounce[world]
    elif bounce_first:
        before += 1
    dead = wp.min(events.floor_time[world], events.edge_time[world])
    lost = before >= 2 or dead < touch
    hit_now = was_open and not hit_before and struck and not lost and before == 1
    outcome = game.referee.outcome[world]
    if was_open and not hit_before:
        if lost:
            outcome = MISS
        elif struck and before == 0:
            outcome = VOLLEY
    if was_open and (hit_before or hit_now):
        since = wp.float32(-1.0)
        own_count = events.own_bounce[world]
        touches = events.paddle_hit[world]
        if hit_now:
            since = touch
            touches -= 1
            if bounce_first:
                own_count -= 1
        outcome = _judge_flight(game, events, world, since, own_count, touches, dead, ball.position[world][0])
    if hit_now:
        game.referee.hit[world] = True
        game.referee.rim[world] = events.hit_rim[world]
    if struck and not game.referee.touched[world]:
        game.referee.touched[world] = True
        game.referee.touch_time[world] = game.clock.time[world] + touch
    game.referee.was_open[world] = was_open
    game.referee.hit_now[world] = hit_now
    game.referee.outcome[world] = outcome
    game.referee.own_bounces[world] += events.own_bounce[world]


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
    """After :func:`judge`: clock, forecast of a hit, approach of the paddle, ends of serves and episodes."""
    world = wp.tid()
    game.clock.time[world] += rules.control_dt
    if game.referee.hit_now[world]:
        _take_return(game, forecast, world)
    _approach(game, world, paddle_distance[world] - radius[world])
    lost = _lost(base_position[world], rules)
    over = _over(game, rules, world, ball.position[world][2], events.floor[world] > 0)
    outcome = game.referee.outcome[world]
    if outcome == OPEN:
        if lost:
            outcome = FALL
        elif over and game.referee.hit[world]:
            landing_x = game.returns.landing[world][0]
            outcome = _landed(
                game.returns.lands_opponent[world],
                game.returns.lands_own[world],
                game.referee.net_touched[world],
                landing_x,
            )
        elif over:
            outcome = MISS
    game.referee.outcome[world] = outcome
    game.referee.success_now[world] = game.referee.was_open[world] and outcome == SUCCESS
    game.ends.lost[world] = lost
    game.ends.over[world] = over or lost
    game.ends.next_serve[world] = over and not lost
    last = rules.serves_per_episode > 0 and game.clock.index[world] + 1.0 >= float(rules.serves_per_episode)
    game.ends.truncated[world] = over and last and not lost
    game.ends.outcome[world] = outcome
    game.ends.hit[world] = game.referee.hit[world]
    game.target.something_to_hit[world] = something_to_hit_now(game, ball, rules, world)


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
        game.target.point[world] = clamp_x(apex, rules.target_x)
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
    outcome = int(BAD_SERVE)
    if game.target.playable[world]:
        outcome = OPEN
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
