"""The rules of a serve: their numbers, and the conditions that several kernels ask, as Warp functions."""

import warp as wp

from pace.sim.ball.state import BallArrays
from pace.task.game_state import GameArrays
from pace.task.outcome import Outcome


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
    table_push: float  # N, mean over a control step


@wp.func
def nothing_to_hit(position: wp.vec3, velocity: wp.vec3, rules: Rules) -> bool:
    """A ball that is past the robot, moves away, is too low, or falls behind the table cannot be hit any more."""
    gone = position[0] < rules.past_x or velocity[0] > 0.0 or position[2] < rules.low_z
    return gone or (position[0] < rules.falling_x and velocity[2] < 0.0)


@wp.func
def something_to_hit_now(game: GameArrays, ball: BallArrays, rules: Rules, world: int) -> bool:
    undecided = game.referee.outcome[world] == Outcome.OPEN and not game.referee.touched[world]
    return undecided and not nothing_to_hit(ball.position[world], ball.velocity[world], rules)


@wp.struct
class Fault:
    """A fault of the robot that no ball makes legal: a touch of the ball by its body, or of the table."""

    time: wp.float32  # s into the control step; infinite if there is none
    outcome: wp.int32


@wp.func
def first_fault(body: float, table: Fault) -> Fault:
    """The earlier of a touch by the body at the time ``body`` and ``table``; the body's of two at the same time."""
    if table.time < body:
        return table
    fault = Fault()
    fault.time = body
    fault.outcome = Outcome.BODY
    return fault


@wp.func
def table_fault(table_force: wp.array3d[wp.vec3], rules: Rules, world: int) -> Fault:
    """The free hand's first touch of the playing surface, or the push of the table before it; the hand's of two in the
    same physics step.

    On the top a contact's force is steeper than 45 degrees, as friction is below 1; on the sides it is flatter. A push
    is a mean force over the control step, so that it does not depend on the physics step: the table moves once the
    impulse is that of ``rules.table_push``.
    """
    fault = Fault()
    fault.time = wp.inf
    steps = table_force.shape[1]
    dt = rules.control_dt / float(steps)
    impulse = wp.vec3()
    for step in range(steps):
        if table_force.shape[2] > 1:
            hand = table_force[world, step, 1]
            if hand[2] > wp.length(wp.vec2(hand[0], hand[1])):
                fault.time = float(step) * dt
                fault.outcome = Outcome.FREE_HAND
                return fault
        impulse += dt * table_force[world, step, 0]
        if wp.length(impulse) > rules.table_push * rules.control_dt:
            fault.time = float(step + 1) * dt
            fault.outcome = Outcome.TABLE_TOUCH
            return fault
    return fault


@wp.func
def landed(opponent: bool, own: bool, net_touched: bool, x: float) -> int:
    """Outcome of a hit ball by where it lands first; off the table it is out, or caught by the net."""
    if opponent:
        return Outcome.SUCCESS
    if net_touched and (own or x < 0.0):
        return Outcome.NET
    if own:
        return Outcome.OWN_SIDE
    return Outcome.OUT
