"""What the robot computes from its sensors, and the histories of both networks' inputs, as Warp kernels.

One thread a world. See :mod:`pace.task.observations`.
"""

import warp as wp

from pace.sim.ball.aero import GRAVITY
from pace.sim.sensing import orientation
from pace.task.game_kernels import LONGEST_TIME, Rules, clamp_x, nothing_to_hit

#: Squared horizontal part of gravity, in the body frame, at which the x axis points up or down and has no heading.
SMALLEST_TILT = wp.constant(1.0e-3)


@wp.func
def _position(positions: wp.array[wp.float32], start: int) -> wp.vec3:
    return wp.vec3(positions[start], positions[start + 1], positions[start + 2])


@wp.kernel
def follow_ball(
    mask: wp.array[wp.bool],
    advance: int,
    sensed: wp.array[wp.vec3],
    positions: wp.array2d[wp.float32],
    turned: wp.array[wp.bool],
    something_to_hit: wp.array[wp.bool],
    rules: Rules,
):
    """Append a sensed position, oldest first. Masked worlds have a new ball; the others keep theirs if not advance."""
    world = wp.tid()
    row = positions[world]
    newest = row.shape[0] - 3
    if not mask[world] and advance == 0:
        return
    for i in range(newest):
        if mask[world]:
            row[i] = sensed[world][i % 3]
        else:
            row[i] = row[i + 3]
    for i in range(3):
        row[newest + i] = sensed[world][i]
    # over two steps: noise matters less. A ball that is seen late stands still at first, but for the noise
    change = _position(row, newest) - _position(row, newest - 6)
    change[0] -= rules.moved
    gone = change[0] > 0.0 or (turned[world] and not mask[world])
    turned[world] = gone
    something_to_hit[world] = not (gone or nothing_to_hit(_position(row, newest), change, rules))


@wp.struct
class PredictionLayout:
    """First columns of the parts of the predictor's output; negative where it has no such part."""

    apex: int
    target: int
    time: int


@wp.kernel
def read_prediction(
    prediction: wp.array2d[wp.float32],
    layout: PredictionLayout,
    something_to_hit: wp.array[wp.bool],
    base_position: wp.array[wp.vec3],
    shift_noise: wp.array[wp.vec2],
    rules: Rules,
    apex: wp.array[wp.vec3],
    target: wp.array[wp.vec3],
    time: wp.array[wp.float32],
    shift: wp.array[wp.vec2],
):
    """Apex, target, time and base shift from the predictor's output; the point to stand by with nothing to hit."""
    world = wp.tid()
    row = prediction[world]
    goal_apex = rules.idle_point
    goal = rules.idle_point
    left = 0.0
    stand = rules.idle_base
    if something_to_hit[world]:
        goal_apex = _position(row, layout.apex)
        goal = clamp_x(goal_apex, rules.target_x)
        if layout.target >= 0:
            goal = _position(row, layout.target)
        if layout.time >= 0:
            left = wp.clamp(row[layout.time], 0.0, LONGEST_TIME)
        above = goal_apex
        if rules.intercept == 1:
            above = goal
        stand = wp.vec2(above[0], above[1]) + rules.arm_offset
    apex[world] = goal_apex
    target[world] = goal
    time[world] = left
    base = base_position[world]
    shift[world] = stand - wp.vec2(base[0], base[1]) + shift_noise[world]


@wp.struct
class SignalArrays:
    """One observation: where it is kept, and its first column in a frame."""

    values: wp.array2d[wp.float32]
    start: int


@wp.kernel
def fill_frames(
    mask: wp.array[wp.bool],
    signals: wp.array[SignalArrays],
    frame: wp.array2d[wp.float32],
    observation: wp.array2d[wp.float32],
):
    """Put the signals of the masked worlds into their newest frame, and make all their frames that one."""
    world = wp.tid()
    if not mask[world]:
        return
    for i in range(signals.shape[0]):
        start = signals[i].start
        values = signals[i].values
        for column in range(values.shape[1]):
            frame[world, start + column] = values[world, column]
    row = observation[world]
    size = frame.shape[1]
    for i in range(row.shape[0]):
        row[i] = frame[world, i % size]


@wp.struct
class MemoryRules:
    """Numbers of :class:`pace.onboard.returns.ReturnMemory`; m, s."""

    control_dt: float
    prior: float
    prior_hits: float
    hits: float
    reach: float
    closing_speed: float
    largest: float


#: Columns of a world's memory: steps since the ball was seen to turn (0: it has not), the paddle's position one and two
#: steps ago and its normal one step ago; of the hit: ball's velocity before it, paddle's velocity and normal; seen:
#: velocity of the last return, estimated restitution above the prior, share of hits.
AGE, POSITION_1, POSITION_2, NORMAL_1 = wp.constant(0), wp.constant(1), wp.constant(4), wp.constant(7)
BEFORE, PADDLE, NORMAL = wp.constant(10), wp.constant(13), wp.constant(16)
RETURN, RESTITUTION, SHARE = wp.constant(19), wp.constant(22), wp.constant(23)
MEMORY_SIZE = 24


@wp.func
def _keep(row: wp.array[wp.float32], start: int, value: wp.vec3):
    for i in range(3):
        row[start + i] = value[i]


@wp.func
def _learn(row: wp.array[wp.float32], after: wp.vec3, rules: MemoryRules):
    """One more estimate of the restitution, from the velocities at the hit."""
    normal = _position(row, NORMAL)
    paddle = _position(row, PADDLE)
    closing = wp.dot(_position(row, BEFORE) - paddle, normal)
    if wp.abs(closing) < rules.closing_speed:
        return
    estimate = wp.clamp(-wp.dot(after - paddle, normal) / closing, 0.0, rules.largest)
    hits = wp.min(row[SHARE] * rules.hits, rules.hits - 1.0)  # older ones fade once there are that many
    weight = hits + rules.prior_hits
    row[RESTITUTION] = (row[RESTITUTION] * weight + estimate - rules.prior) / (weight + 1.0)
    row[SHARE] = (hits + 1.0) / rules.hits


@wp.kernel
def remember_return(
    track: wp.array2d[wp.float32],
    turned: wp.array[wp.bool],
    paddle_position: wp.array[wp.vec3],
    paddle_normal: wp.array[wp.vec3],
    rules: MemoryRules,
    memory: wp.array2d[wp.float32],
):
    """One control step of a world's memory; ``track`` holds the ball's last positions, oldest first.

    :class:`pace.onboard.steps.ReturnMemoryStep` does the same in an exported policy.
    """
    world = wp.tid()
    row, ball = memory[world], track[world]
    newest = ball.shape[0] - 3
    paddle = paddle_position[world]
    age = 0.0
    if turned[world]:
        age = wp.min(row[AGE] + 1.0, 4.0)
    fall = wp.vec3(0.0, 0.0, 2.0 * rules.control_dt * GRAVITY)  # in the two steps to the hit, and from it
    span = 2.0 * rules.control_dt
    if age == 1.0:
        _keep(row, BEFORE, (_position(ball, newest - 6) - _position(ball, newest - 12)) / span - fall)
        _keep(row, PADDLE, (paddle - _position(row, POSITION_2)) / span)
        _keep(row, NORMAL, _position(row, NORMAL_1))
        if wp.length(_position(ball, newest) - paddle) > rules.reach:
            age = 4.0  # not the paddle turned it
    if age == 3.0:
        after = (_position(ball, newest) - _position(ball, newest - 6)) / span
        _keep(row, RETURN, after)
        _learn(row, after + fall, rules)
    row[AGE] = age
    _keep(row, POSITION_2, _position(row, POSITION_1))
    _keep(row, POSITION_1, paddle)
    _keep(row, NORMAL_1, paddle_normal[world])


@wp.func
def yaw_rate(down: wp.vec3, turning: wp.vec3) -> float:
    """How fast (rad/s) the trunk's x axis turns on the ground; rotation about that axis does not turn it."""
    return -(down[1] * turning[1] + down[2] * turning[2]) / wp.max(down[1] * down[1] + down[2] * down[2], SMALLEST_TILT)


@wp.struct
class DelayRules:
    """Numbers of :class:`pace.onboard.delay.DelayEstimate`; s, rad^2/s^2."""

    control_dt: float
    prior: float
    prior_worth: float
    smoothing: float
    fading: float


#: Columns of a world's estimate of the delay: 1 once anything was seen; yaw (rad) and yaw rate (rad/s) one step ago;
#: filtered: how far the yaw is behind what the rate says (rad), and the change of the rate (rad/s); the sums of their
#: products and of the change's squares; the estimate above the prior (s).
KNOWN, YAW, RATE, BEHIND = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)
CHANGE, PRODUCTS, SQUARES, ESTIMATE = wp.constant(4), wp.constant(5), wp.constant(6), wp.constant(7)
DELAY_SIZE = 8


@wp.kernel
def estimate_delay(
    mask: wp.array[wp.bool],
    restart: int,
    angular_velocity: wp.array[wp.vec3],
    gravity: wp.array[wp.vec3],
    heading: wp.array2d[wp.float32],
    rules: DelayRules,
    estimate: wp.array2d[wp.float32],
):
    """One control step of a world's estimate; with ``restart`` the masked worlds begin anew, and the others wait.

    :class:`pace.onboard.steps.DelayEstimateStep` does the same in an exported policy.
    """
    world = wp.tid()
    row = estimate[world]
    if restart == 1:
        if not mask[world]:
            return
        for column in range(row.shape[0]):
            row[column] = 0.0
    rate = yaw_rate(gravity[world], angular_velocity[world])
    yaw = wp.atan2(heading[world, 1], heading[world, 0])
    if row[KNOWN] == 1.0:
        turn = yaw - row[YAW]
        turn -= 2.0 * wp.pi * wp.round(turn / (2.0 * wp.pi))
        said = 0.5 * rules.control_dt * (rate + row[RATE])
        row[BEHIND] = rules.smoothing * row[BEHIND] + said - turn
        row[CHANGE] = rules.smoothing * row[CHANGE] + rate - row[RATE]
        row[PRODUCTS] = rules.fading * row[PRODUCTS] + row[CHANGE] * row[BEHIND]
        row[SQUARES] = rules.fading * row[SQUARES] + row[CHANGE] * row[CHANGE]
        row[ESTIMATE] = (row[PRODUCTS] - rules.prior * row[SQUARES]) / (row[SQUARES] + rules.prior_worth)
    row[KNOWN] = 1.0
    row[YAW] = yaw
    row[RATE] = rate


#: Columns of a world's attitude: 1 once anything was seen; estimated direction of gravity (body frame) and heading; the
#: angular velocity one step ago.
SEEN_ONCE, DOWN, FORWARD, TURNING = wp.constant(0), wp.constant(1), wp.constant(4), wp.constant(6)
ATTITUDE_SIZE = 9


@wp.kernel
def estimate_attitude(
    mask: wp.array[wp.bool],
    restart: int,
    angular_velocity: wp.array[wp.vec3],
    gravity: wp.array[wp.vec3],
    heading: wp.array2d[wp.float32],
    control_dt: float,
    gain: float,
    attitude: wp.array2d[wp.float32],
    quat: wp.array[wp.vec4],
):
    """One control step of a world's attitude; with ``restart`` the masked worlds begin anew, and the others wait.

    :class:`pace.onboard.steps.AttitudeEstimateStep` does the same in an exported policy.
    """
    world = wp.tid()
    row = attitude[world]
    if restart == 1 and not mask[world]:
        return
    seen, turning = gravity[world], angular_velocity[world]
    down = wp.normalize(seen)
    forward = wp.normalize(wp.vec2(heading[world, 0], heading[world, 1]))
    if restart == 0 and row[SEEN_ONCE] == 1.0:
        mean = 0.5 * (turning + _position(row, TURNING))
        last = _position(row, DOWN)
        down = wp.normalize((1.0 - gain) * (last + control_dt * wp.cross(last, mean)) + gain * seen)
        angle = control_dt * yaw_rate(down, mean)
        c, s = wp.cos(angle), wp.sin(angle)
        x, y = row[FORWARD], row[FORWARD + 1]
        ahead = (1.0 - gain) * wp.vec2(c * x - s * y, s * x + c * y) + gain * wp.vec2(
            heading[world, 0], heading[world, 1]
        )
        forward = wp.normalize(ahead)
    row[SEEN_ONCE] = 1.0
    _keep(row, DOWN, down)
    row[FORWARD] = forward[0]
    row[FORWARD + 1] = forward[1]
    _keep(row, TURNING, turning)
    quat[world] = orientation(down, forward[0], forward[1])


#: Column of a world's joints where the positions begin, the velocities after them; before it, 1 once anything was seen.
FIRST_JOINT = wp.constant(1)


@wp.kernel
def estimate_joints(
    mask: wp.array[wp.bool],
    restart: int,
    position: wp.array2d[wp.float32],
    velocity: wp.array2d[wp.float32],
    control_dt: float,
    gain: wp.mat22,
    estimate: wp.array2d[wp.float32],
):
    """One control step of a world's joints; with ``restart`` the masked worlds begin anew, and the others wait.

    :class:`pace.onboard.steps.JointEstimateStep` does the same in an exported policy.
    """
    world = wp.tid()
    row = estimate[world]
    if restart == 1 and not mask[world]:
        return
    anew = restart == 1 or row[0] != 1.0
    share = gain  # of what is sensed
    if anew:
        share = wp.identity(2, dtype=wp.float32)
    row[0] = 1.0
    count = position.shape[1]
    for joint in range(count):
        at, turning = FIRST_JOINT + joint, FIRST_JOINT + count + joint
        if anew:  # whatever was there before
            row[at] = 0.0
            row[turning] = 0.0
        speed = wp.float32(row[turning])
        said = row[at] + control_dt * speed
        learned = share * wp.vec2(position[world, joint] - said, velocity[world, joint] - speed)
        row[at] = said + learned[0]
        row[turning] = speed + learned[1]
