"""Quantities of the robots for the reward terms, as a Warp kernel, one thread a world. See :mod:`pace.task.state`."""

import warp as wp

from pace.onboard.prediction import LONGEST_TIME
from pace.sim.ball.state import BallArrays
from pace.sim.robot_state import RobotArrays
from pace.task.game_state import GameArrays
from pace.task.measures import DerivedArrays, MeasureArrays
from pace.task.rules import Rules, something_to_hit_now

#: Contact threshold of a foot's force, N.
CONTACT_FORCE = wp.constant(1.0)


@wp.struct
class JointArrays:
    """Per joint: its nominal position, rad, and 1 if it belongs to a group of ``JOINT_GROUPS``."""

    nominal: wp.array[wp.float32]
    ankles: wp.array[wp.float32]
    hip_waist_left_arm: wp.array[wp.float32]
    left_shoulder_roll: wp.array[wp.float32]
    right_arm: wp.array[wp.float32]


@wp.func
def _measure_joints(
    robot: RobotArrays,
    action: wp.array2d[wp.float32],
    previous_action: wp.array2d[wp.float32],
    joints: JointArrays,
    measures: MeasureArrays,
    world: int,
):
    power = wp.float32(0.0)
    ankle_power = wp.float32(0.0)
    acceleration = wp.float32(0.0)
    change = wp.float32(0.0)
    middle = wp.float32(0.0)
    left_roll = wp.float32(0.0)
    right = wp.float32(0.0)
    for joint in range(joints.nominal.shape[0]):
        watts = robot.joint_torque[world, joint] * robot.joint_velocity[world, joint]
        power += watts * watts
        ankle_power += joints.ankles[joint] * watts * watts
        acceleration += robot.joint_acceleration[world, joint] * robot.joint_acceleration[world, joint]
        step = action[world, joint] - previous_action[world, joint]
        change += step * step
        deviation = wp.abs(robot.joint_position[world, joint] - joints.nominal[joint])
        middle += joints.hip_waist_left_arm[joint] * deviation
        left_roll += joints.left_shoulder_roll[joint] * deviation
        right += joints.right_arm[joint] * deviation
    measures.joint_power[world] = wp.sqrt(power)
    measures.ankle_power[world] = wp.sqrt(ankle_power)
    measures.joint_acceleration[world] = acceleration
    measures.action_change[world] = change
    measures.hip_waist_left_arm[world] = middle
    measures.left_shoulder_roll[world] = left_roll
    measures.right_arm[world] = right


@wp.func
def _horizontal(vector: wp.vec3) -> wp.vec2:
    return wp.vec2(vector[0], vector[1])


@wp.func
def _measure_feet(robot: RobotArrays, contact: wp.array2d[wp.bool], measures: MeasureArrays, world: int):
    tilt = wp.float32(0.0)
    slide = wp.float32(0.0)
    steepness = wp.float32(0.0)
    down = wp.float32(0.0)
    for foot in range(2):
        tilt += wp.length_sq(_horizontal(robot.foot_up[world, foot]))
        if contact[world, foot]:
            down += 1.0
            force = robot.foot_force[world, foot]
            slide += wp.length(_horizontal(robot.foot_velocity[world, foot]))
            steepness = wp.max(steepness, wp.length(_horizontal(force)) / wp.abs(force[2]))
    measures.foot_tilt[world] = tilt
    measures.foot_slide[world] = slide
    measures.foot_steepness[world] = steepness
    measures.feet_down[world] = down


@wp.func
def _measure_base(robot: RobotArrays, measures: MeasureArrays, world: int):
    velocity, rate = robot.base_linear_velocity[world], robot.base_angular_velocity[world]
    measures.vertical_velocity[world] = velocity[2] * velocity[2]
    measures.roll_pitch_rate[world] = wp.length_sq(_horizontal(rate))
    measures.yaw_rate[world] = rate[2] * rate[2]
    measures.base_tilt[world] = wp.length_sq(_horizontal(robot.projected_gravity[world]))
    contacts = wp.float32(0.0)
    for body in range(robot.body_contact.shape[1]):
        contacts += robot.body_contact[world, body]
    measures.contacts[world] = contacts


@wp.kernel
def measure(
    robot: RobotArrays,
    action: wp.array2d[wp.float32],
    previous_action: wp.array2d[wp.float32],
    joints: JointArrays,
    foot_contact: wp.array2d[wp.bool],
    point: wp.array[wp.vec3],
    base_error: wp.array[wp.vec2],
    measures: MeasureArrays,
):
    """Sums over the joints and feet of one world, its base's motion, and the errors of paddle and base to their
    targets."""
    world = wp.tid()
    _measure_joints(robot, action, previous_action, joints, measures, world)
    _measure_feet(robot, foot_contact, measures, world)
    _measure_base(robot, measures, world)
    paddle = robot.paddle_position[world]
    measures.paddle_to_head[world] = wp.length(paddle - robot.head_position[world])
    measures.paddle_to_target[world] = wp.length(paddle - point[world])
    measures.base_to_target[world] = wp.length(base_error[world])


@wp.func
def _derive_feet(robot: RobotArrays, derived: DerivedArrays, world: int):
    for foot in range(2):
        load = wp.length(robot.foot_force[world, foot])
        derived.foot_load[world, foot] = load
        derived.foot_contact[world, foot] = load > CONTACT_FORCE
    derived.feet_distance[world] = wp.length(robot.foot_position[world, 0] - robot.foot_position[world, 1])


@wp.func
def _derive_progress(game: GameArrays, derived: DerivedArrays, rules: Rules, world: int):
    progress = game.clock.time[world] / rules.max_duration
    derived.serve_progress[world] = progress
    episode = 0.0
    if rules.serves_per_episode > 0:
        episode = wp.min((game.clock.index[world] + progress) / float(rules.serves_per_episode), 1.0)
    derived.episode_progress[world] = episode


@wp.kernel
def derive(
    game: GameArrays,
    derived: DerivedArrays,
    ball: BallArrays,
    robot: RobotArrays,
    nominal: wp.array[wp.float32],
    rules: Rules,
):
    """Shared quantities of one world from its current state."""
    world = wp.tid()
    something = something_to_hit_now(game, ball, rules, world)
    game.target.something_to_hit[world] = something
    apex = rules.idle_point
    target = rules.idle_point
    arrival = 0.0
    goal = rules.idle_base
    shift_goal = rules.idle_base
    if something:
        apex = game.target.apex[world]
        target = game.target.point[world]
        arrival = wp.clamp(game.target.time[world] - game.clock.time[world], 0.0, LONGEST_TIME)
        goal = wp.vec2(target[0], target[1]) + rules.arm_offset
        shift_goal = goal
        if rules.intercept == 0:  # the paper's base shift is that of the apex itself
            shift_goal = wp.vec2(apex[0], apex[1]) + rules.arm_offset
    base = _horizontal(robot.base_position[world])
    derived.apex[world] = apex
    derived.target[world] = target
    derived.arrival[world] = arrival
    derived.paddle_to_target[world] = target - robot.paddle_position[world]
    for joint in range(nominal.shape[0]):
        derived.joint_offset[world, joint] = robot.joint_position[world, joint] - nominal[joint]
    _derive_progress(game, derived, rules, world)
    derived.base_error[world] = goal - base
    derived.shift[world] = shift_goal - base
    _derive_feet(robot, derived, world)
