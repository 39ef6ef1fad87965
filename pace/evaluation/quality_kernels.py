"""Counts and sums of the quality of play as a Warp kernel, one thread a world. See :mod:`pace.evaluation.quality`."""

from dataclasses import dataclass
from typing import Annotated

import warp as wp

from pace.arrays.tensors import Bool, Float, Int, Start, Vec2, struct_of
from pace.sim.robot_state import RobotArrays
from pace.task.game_state import GameArrays

HEIGHT_BIN = wp.constant(0.001)  # m, of the histogram of the base's height
HEIGHT_BINS = wp.constant(2000)
#: Phases of play: with a ball that can be hit, just after a hit, and without either.
AT_BALL, AFTER_HIT, WAITING = wp.constant(0), wp.constant(1), wp.constant(2)

Phases = Annotated[Float, "phases"]  # (N, 3)
Counts = Annotated[Int, "phases"]


@dataclass(eq=False)
class QualitySums:
    """Sums and counts of N worlds over the control steps of counted serves."""

    instants: Counts
    no_foot: Counts  # no foot on the floor
    lifted: Counts  # feet that left the floor
    foot_slide: Phases  # m/s, horizontal speeds of the feet on the floor
    base_speed: Phases  # m/s, horizontal
    lean: Phases  # rad, of the trunk from the vertical
    joint_square: Phases  # (rad/s)^2, mean over the joints
    power: Phases  # W, |torque x speed| over the joints
    height: Float  # m, of the base
    sway: Float  # m^2, variances of the windows
    windows: Int  # that are complete
    range_end: Annotated[Int, "joints"]  # instants at an end of the joint's range
    torque_limit: Annotated[Int, "joints"]  # instants at the motor's limit
    touches: Annotated[Int, "bodies"]  # instants in which the body touches anything


@struct_of(QualitySums)
class SumArrays:
    """:class:`QualitySums` in the kernels' form."""


@dataclass(eq=False)
class QualityTrack:
    """What is remembered of N worlds from one control step to the next."""

    down: Annotated[Bool, "feet", Start(True)]  # the foot was on the floor
    since_hit: Annotated[Int, Start(-1)]  # control steps since the hit of the current serve, -1 without one
    calm_from: Int  # control steps after the hit from which on the joints have been slow
    window: Int  # control steps in the current window
    origin: Vec2  # m, the base when the window began
    offset: Vec2  # m, sum of the base's positions in the window, from its origin
    square: Float  # m^2, sum of the squares of them


@struct_of(QualityTrack)
class TrackArrays:
    """:class:`QualityTrack` in the kernels' form."""


@wp.struct
class JointLimits:
    """Of each joint: where the ends of its range begin (rad), and its motor's effort and line."""

    low: wp.array[wp.float32]
    high: wp.array[wp.float32]
    effort: wp.array[wp.float32]  # N m
    stall: wp.array[wp.float32]  # N m; 0: a motor without a torque-speed line
    speed: wp.array[wp.float32]  # rad/s


@wp.struct
class QualityRules:
    """Numbers of the configuration."""

    control_dt: float  # s
    warmup: int  # first serves, which are not counted
    quota: int  # serves that are
    window: int  # control steps
    after_hit: int  # control steps
    calm_square: float  # (rad/s)^2
    slack: float


@wp.func
def _at_limit(torque: float, speed: float, scale: float, limits: JointLimits, slack: float, joint: int) -> bool:
    """The torque is the largest that the motor's effort, or its line at this speed, allows."""
    held = wp.abs(torque) >= (1.0 - slack) * scale * limits.effort[joint]
    stall = scale * limits.stall[joint]
    if stall > 0.0:
        along = torque * wp.sign(speed)
        held = held or along - stall * (1.0 - wp.abs(speed) / limits.speed[joint]) > -slack * stall
    return held


@wp.func
def _joints(
    robot: RobotArrays,
    qvel: wp.array3d[wp.float32],
    scale: float,
    limits: JointLimits,
    slack: float,
    phase: int,
    sums: SumArrays,
    world: int,
):
    """Add a counted instant of the joints."""
    instant = qvel.shape[1] - 2  # at which the last torque was computed
    power = wp.float32(0.0)
    for joint in range(limits.low.shape[0]):
        torque, speed = robot.joint_torque[world, joint], robot.joint_velocity[world, joint]
        power += wp.abs(torque * speed)
        position = robot.joint_position[world, joint]
        if position < limits.low[joint] or position > limits.high[joint]:
            sums.range_end[world, joint] += 1
        if _at_limit(torque, qvel[world, instant, 6 + joint], scale, limits, slack, joint):
            sums.torque_limit[world, joint] += 1
    sums.power[world, phase] += power


@wp.func
def _mean_square(robot: RobotArrays, world: int) -> float:
    """(rad/s)^2, mean over the joints."""
    square = wp.float32(0.0)
    for joint in range(robot.joint_velocity.shape[1]):
        square += robot.joint_velocity[world, joint] * robot.joint_velocity[world, joint]
    return square / float(robot.joint_velocity.shape[1])


@wp.func
def _feet(
    contact: wp.array2d[wp.bool], counted: bool, lost: bool, phase: int, sums: SumArrays, track: TrackArrays, world: int
):
    """Feet that leave the floor, and instants without a foot on it. A reset puts both feet down."""
    standing = wp.int32(0)
    for foot in range(contact.shape[1]):
        down = contact[world, foot]
        if down:
            standing += 1
        if counted and track.down[world, foot] and not down:
            sums.lifted[world, phase] += 1
        track.down[world, foot] = down or lost
    if counted and standing == 0:
        sums.no_foot[world, phase] += 1


@wp.func
def _base(robot: RobotArrays, phase: int, heights: wp.array[wp.int32], sums: SumArrays, world: int):
    """Height, speed and lean of a counted instant; the height also into its histogram."""
    height = robot.base_position[world][2]
    sums.height[world] += height
    wp.atomic_add(heights, wp.clamp(int(height / HEIGHT_BIN), 0, HEIGHT_BINS - 1), 1)
    velocity = robot.base_linear_velocity[world]
    sums.base_speed[world, phase] += wp.length(wp.vec2(velocity[0], velocity[1]))
    sums.lean[world, phase] += wp.acos(wp.clamp(-robot.projected_gravity[world][2], -1.0, 1.0))


@wp.func
def _sway(robot: RobotArrays, on: bool, length: int, sums: SumArrays, track: TrackArrays, world: int):
    """Variance of the base's horizontal position over windows of ``length`` control steps without interruption."""
    if not on:
        track.window[world] = 0
        return
    base = wp.vec2(robot.base_position[world][0], robot.base_position[world][1])
    if track.window[world] == 0:
        track.origin[world] = base
        track.offset[world] = wp.vec2(0.0)
        track.square[world] = 0.0
    moved = base - track.origin[world]  # float32: the position itself is large
    track.offset[world] += moved
    track.square[world] += wp.length_sq(moved)
    track.window[world] += 1
    if track.window[world] == length:
        mean = track.offset[world] / float(length)
        sums.sway[world] += wp.max(track.square[world] / float(length) - wp.length_sq(mean), 0.0)
        sums.windows[world] += 1
        track.window[world] = 0


@wp.func
def _phase(game: GameArrays, rules: QualityRules, track: TrackArrays, world: int) -> int:
    """The phase of the last control step, once the hit is known."""
    if game.referee.hit_now[world]:
        track.since_hit[world] = 0
        track.calm_from[world] = 0
    elif track.since_hit[world] >= 0:
        track.since_hit[world] += 1
    since = track.since_hit[world]
    phase = int(WAITING)
    if game.target.something_to_hit[world]:
        phase = AT_BALL
    elif since >= 0 and since < rules.after_hit:
        phase = AFTER_HIT
    return phase


@wp.func
def _recover(square: float, over: bool, calm_square: float, calms: wp.array[wp.int32], track: TrackArrays, world: int):
    """Control steps from the hit of a counted serve until the joints stay slow to the serve's end.

    The last number of the histogram ``calms`` counts the serves at whose end they are not.
    """
    since = track.since_hit[world]
    if since >= 0 and square > calm_square:
        track.calm_from[world] = since + 1
    if since >= 0 and over:
        never = calms.shape[0] - 1
        steps = wp.min(track.calm_from[world], never - 1)
        wp.atomic_add(calms, wp.where(track.calm_from[world] > since, never, steps), 1)


@wp.kernel
def watch(
    robot: RobotArrays,
    game: GameArrays,
    qvel: wp.array3d[wp.float32],
    effort_scale: wp.array[wp.float32],
    foot_contact: wp.array2d[wp.bool],
    foot_slide: wp.array[wp.float32],
    played: wp.array[wp.int64],
    counted: wp.array[wp.int64],
    limits: JointLimits,
    rules: QualityRules,
    sums: SumArrays,
    track: TrackArrays,
    heights: wp.array[wp.int32],
    calms: wp.array[wp.int32],
):
    """Add the last control step of each world whose current serve is counted."""
    world = wp.tid()
    counts = played[world] >= wp.int64(rules.warmup) and counted[world] < wp.int64(rules.quota)
    lost, over = game.ends.lost[world], game.ends.over[world]
    phase = _phase(game, rules, track, world)
    _feet(foot_contact, counts, lost, phase, sums, track, world)
    _sway(robot, counts and phase == WAITING and not lost, rules.window, sums, track, world)
    if counts:
        square = _mean_square(robot, world)
        sums.instants[world, phase] += 1
        sums.joint_square[world, phase] += square
        sums.foot_slide[world, phase] += foot_slide[world]
        _base(robot, phase, heights, sums, world)
        _joints(robot, qvel, effort_scale[world], limits, rules.slack, phase, sums, world)
        for body in range(robot.body_contact.shape[1]):
            if robot.body_contact[world, body] > 0.0:
                sums.touches[world, body] += 1
        _recover(square, over, rules.calm_square, calms, track, world)
    if over or lost:
        track.since_hit[world] = -1
