"""The referee as a Warp kernel, one thread a world. See :mod:`pace.task.game`."""

import warp as wp

from pace.sim.ball.state import BallArrays, EventArrays
from pace.task.game_state import GameArrays
from pace.task.outcome import Outcome
from pace.task.rules import Fault, Rules, first_fault, landed, table_fault


@wp.func
def _after(time: float, since: float) -> float:
    if time > since:
        return time
    return wp.inf


@wp.func
def _judge_flight(
    game: GameArrays,
    events: EventArrays,
    world: int,
    since: float,
    own_count: int,
    touches: int,
    dead: float,
    fault: Fault,
    x: float,
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
    if _after(fault.time, since) < first:
        return fault.outcome
    if first == wp.inf:
        return Outcome.OPEN
    if again == first and opponent > first and own > first:
        return Outcome.DOUBLE_HIT
    return landed(opponent == first, own == first, game.referee.net_touched[world], x)


@wp.func
def _note_touch(game: GameArrays, events: EventArrays, hit_now: bool, world: int):
    """Remember a legal hit, and when the paddle first touched the ball."""
    if hit_now:
        game.referee.hit[world] = True
        game.referee.rim[world] = events.hit_rim[world]
    if events.paddle_hit[world] > 0 and not game.referee.touched[world]:
        game.referee.touched[world] = True
        game.referee.touch_time[world] = game.clock.time[world] + events.paddle_hit_time[world]


@wp.func
def _missed_time(events: EventArrays, before: int, touch: float, dead: float, world: int) -> float:
    """When the ball is lost unhit: at the second of ``before`` bounces, or where it is dead before the ``touch``."""
    missed = wp.float32(wp.inf)
    if before >= 2:
        missed = events.own_bounce_time[world]
    if dead < touch:
        missed = wp.min(missed, dead)
    return missed


@wp.kernel
def judge(game: GameArrays, events: EventArrays, ball: BallArrays, table_force: wp.array3d[wp.vec3], rules: Rules):
    """The referee: consume the events of one control step in the order of their times."""
    world = wp.tid()
    was_open = game.referee.outcome[world] == Outcome.OPEN
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
    missed = _missed_time(events, before, touch, dead, world)
    lost = missed < wp.inf
    fault = first_fault(events.body_time[world], table_fault(table_force, rules, world))
    at_fault = fault.time < wp.min(touch, missed)
    hit_now = was_open and not hit_before and struck and not lost and not at_fault and before == 1
    outcome = game.referee.outcome[world]
    if was_open and not hit_before:
        if at_fault:
            outcome = fault.outcome
        elif lost:
            outcome = Outcome.MISS
        elif struck and before == 0:
            outcome = Outcome.VOLLEY
    if was_open and (hit_before or hit_now):
        since = wp.float32(-1.0)
        own_count = events.own_bounce[world]
        touches = events.paddle_hit[world]
        if hit_now:
            since = touch
            touches -= 1
            if bounce_first:
                own_count -= 1
        outcome = _judge_flight(game, events, world, since, own_count, touches, dead, fault, ball.position[world][0])
    _note_touch(game, events, hit_now, world)
    game.referee.was_open[world] = was_open
    game.referee.hit_now[world] = hit_now
    game.referee.outcome[world] = outcome
    game.referee.own_bounces[world] += events.own_bounce[world]
