"""What reward terms measure on robots, as a Warp kernel, one thread a world. See :mod:`pace.task.state`."""

import warp as wp

from pace.onboard.prediction import LONGEST_TIME
from pace.task.game_kernels import GameArrays, Rules, something_to_hit_now

#: A foot that pushes with less touches nothing, N.
CONTACT_FORCE = wp.constant(1.0)


@wp.struct
class RobotArrays:
    """Tensors of :class:`pace.sim.worlds.RobotState`, and the actions."""

    joint_velocity: wp.array2d[wp.float32]
    joint_acceleration: wp.array2d[wp.float32]
    joint_torque: wp.array2d[wp.float32]
    joint_position: wp.array2d[wp.float32]
    foot_force: wp.array2d[wp.vec3]
    foot_velocity: wp.array2d[wp.vec3]
    foot_up: wp.array2d[wp.vec3]
    paddle_position: wp.array[wp.vec3]
    head_position: wp.array[wp.vec3]
    base_linear_velocity: wp.array[wp.vec3]
    base_angular_velocity: wp.array[wp.vec3]
    projected_gravity: wp.array[wp.vec3]
    body_contact: wp.array2d[wp.float32]
    action: wp.array2d[wp.float32]
    previous_action: wp.array2d[wp.float32]


@wp.struct
class JointArrays:
    """Per joint: its nominal position, rad, and 1 where it belongs to a group of ``JOINT_GROUPS``."""

    nominal: wp.array[wp.float32]
    ankles: wp.array[wp.float32]
    hip_waist_left_arm: wp.array[wp.float32]
    left_shoulder_roll: wp.array[wp.float32]
    right_arm: wp.array[wp.float32]


@wp.struct
class Measures:
    """Results, tensors of :class:`pace.task.state.TaskState`."""

    joint_power: wp.array[wp.float32]
    ankle_power: wp.array[wp.float32]
    joint_acceleration: wp.array[wp.float32]
    action_change: wp.array[wp.float32]
    hip_waist_left_arm: wp.array[wp.float32]
    left_shoulder_roll: wp.array[wp.float32]
    right_arm: wp.array[wp.float32]
    foot_tilt: wp.array[wp.float32]
    foot_slide: wp.array[wp.float32]
    foot_steepness: wp.array[wp.float32]
    paddle_to_head: wp.array[wp.float32]
    paddle_to_target: wp.array[wp.float32]
    base_to_target: wp.array[wp.float32]
    vertical_velocity: wp.array[wp.float32]
    roll_pitch_rate: wp.array[wp.float32]
    yaw_rate: wp.array[wp.float32]
    base_tilt: wp.array[wp.float32]
    contacts: wp.array[wp.float32]
    feet_down: wp.array[wp.float32]


@wp.func
def _measure_joints(robot: RobotArrays, joints: JointArrays, measures: Measures, world: int):
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
        step = robot.action[world, joint] - robot.previous_action[world, joint]
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
def _measure_feet(robot: RobotArrays, contact: wp.array2d[wp.bool], measures: Measures, world: int):
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
def _measure_base(robot: RobotArrays, measures: Measures, world: int):
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
    joints: JointArrays,
    foot_contact: wp.array2d[wp.bool],
    point: wp.array[wp.vec3],
    base_error: wp.array[wp.vec2],
    measures: Measures,
):
    """Sums over the joints and feet of one world, its base's motion, and how far paddle and base are from where they
    should be."""
    world = wp.tid()
    _measure_joints(robot, joints, measures, world)
    _measure_feet(robot, foot_contact, measures, world)
    _measure_base(robot, measures, world)
    paddle = robot.paddle_position[world]
    measures.paddle_to_head[world] = wp.length(paddle - robot.head_position[world])
    measures.paddle_to_target[world] = wp.length(paddle - point[world])
    measures.base_to_target[world] = wp.length(base_error[world])


@wp.struct
class DerivedArrays:
    """What rewards and the critic share: tensors of :class:`pace.task.state.TaskState`."""

    base_error: wp.array[wp.vec2]
    apex: wp.array[wp.vec3]
    target: wp.array[wp.vec3]
    arrival: wp.array[wp.float32]
    shift: wp.array[wp.vec2]
    foot_load: wp.array2d[wp.float32]
    foot_contact: wp.array2d[wp.bool]
    feet_distance: wp.array[wp.float32]
    paddle_to_target: wp.array[wp.vec3]
    joint_offset: wp.array2d[wp.float32]
    serve_progress: wp.array[wp.float32]
    episode_progress: wp.array[wp.float32]


@wp.kernel
def derive(
    game: GameArrays,
    derived: DerivedArrays,
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    base_position: wp.array[wp.vec3],
    paddle_position: wp.array[wp.vec3],
    joint_position: wp.array2d[wp.float32],
    nominal: wp.array[wp.float32],
    foot_force: wp.array3d[wp.float32],
    foot_position: wp.array3d[wp.float32],
    rules: Rules,
):
    """Shared quantities of one world from its present state."""
    world = wp.tid()
    something = something_to_hit_now(game, position[world], velocity[world], rules, world)
    game.something_to_hit[world] = something
    apex = rules.idle_point
    target = rules.idle_point
    arrival = 0.0
    goal = rules.idle_base
    shift_goal = rules.idle_base
    if something:
        apex = game.apex[world]
        target = game.point[world]
        arrival = wp.clamp(game.target_time[world] - game.time[world], 0.0, LONGEST_TIME)
        goal = wp.vec2(target[0], target[1]) + rules.arm_offset
        shift_goal = goal
        if rules.intercept == 0:  # the paper's base shift is that of the apex itself
            shift_goal = wp.vec2(apex[0], apex[1]) + rules.arm_offset
    base = wp.vec2(base_position[world][0], base_position[world][1])
    derived.apex[world] = apex
    derived.target[world] = target
    derived.arrival[world] = arrival
    derived.paddle_to_target[world] = target - paddle_position[world]
    for joint in range(nominal.shape[0]):
        derived.joint_offset[world, joint] = joint_position[world, joint] - nominal[joint]
    progress = game.time[world] / rules.max_duration
    derived.serve_progress[world] = progress
    episode = 0.0
    if rules.serves_per_episode > 0:
        episode = wp.min((game.index[world] + progress) / float(rules.serves_per_episode), 1.0)
    derived.episode_progress[world] = episode
    derived.base_error[world] = goal - base
    derived.shift[world] = shift_goal - base
    apart = wp.vec3()
    for foot in range(2):
        load = wp.vec3(foot_force[world, foot, 0], foot_force[world, foot, 1], foot_force[world, foot, 2])
        derived.foot_load[world, foot] = wp.length(load)
        derived.foot_contact[world, foot] = wp.length(load) > CONTACT_FORCE
    for i in range(3):
        apart[i] = foot_position[world, 0, i] - foot_position[world, 1, i]
    derived.feet_distance[world] = wp.length(apart)
