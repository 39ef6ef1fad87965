"""The MuJoCo model of robot, table and floor, with gains, limits and solver taken from the configuration."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from pace.config.ball import TableConfig
from pace.config.base import ConfigError
from pace.config.sim import EngineConfig, JointGroup, RobotConfig
from pace.sim.robot_spec import PADDLE, TABLE_FORCES, TOUCH, RobotSpec, model_path, read_scene

#: Name of the keyframe: nominal pose, soles on the floor.
NOMINAL_KEY = "nominal"
#: Group of the geoms that are only for display.
VISUAL_GROUP = 2
#: Of a contact sensor: the sum of all contacts that match.
NET_FORCE = 3
#: The only input of a motor: its target position.
POSITION = int(mujoco.mjtCtrlInput.mjINPUT_POS)


def nominal_pose(robot: RobotConfig) -> NDArray[np.float64]:
    """Nominal joint positions (J,), rad, in the order of ``RobotSpec.joints``.

    Errors: :class:`ConfigError` for a joint that the robot does not have.
    """
    joints = RobotSpec.of(robot).joints
    unknown = sorted(set(robot.nominal_pose) - set(joints))
    if unknown:
        raise ConfigError(f"robot.nominal_pose names no joint of the robot: {', '.join(unknown)}")
    return np.array([robot.nominal_pose.get(name, 0.0) for name in joints])


def joint_gains(robot: RobotConfig) -> NDArray[np.float64]:
    """Rows kp (N m/rad), kd (N m s/rad) and effort (N m) of every joint: (3, J).

    Errors: :class:`ConfigError` for a joint that no group of ``robot.joint_groups`` matches.
    """
    groups = [joint_group(robot, name) for name in RobotSpec.of(robot).joints]
    return np.array([(group.kp, group.kd, group.effort) for group in groups]).T


def motor_lines(robot: RobotConfig) -> NDArray[np.float64] | None:
    """Rows no-load speed (rad/s) and stall torque (N m) of every joint: (2, J); None: motors without a speed limit.

    A motor's largest torque falls on a line from its stall torque at rest to zero at its no-load speed.
    Errors: those of :func:`joint_gains`.
    """
    if not robot.stall_ratio:
        return None
    stall = robot.stall_ratio * joint_gains(robot)[2]
    return np.array([[joint_group(robot, name).max_speed for name in RobotSpec.of(robot).joints], stall])


def joint_armature(robot: RobotConfig) -> NDArray[np.float64]:
    """Armature (J,), kg m^2, of every joint: its group's, or ``robot.armature``.

    Errors: those of :func:`joint_gains`.
    """
    found = [joint_group(robot, name).armature for name in RobotSpec.of(robot).joints]
    return np.array([robot.armature if armature is None else armature for armature in found])


def joint_friction(robot: RobotConfig) -> NDArray[np.float64]:
    """Dry friction (J,), N m, of every joint.

    Errors: those of :func:`joint_gains`.
    """
    return np.array([joint_group(robot, name).friction for name in RobotSpec.of(robot).joints])


def joint_group(robot: RobotConfig, name: str) -> JointGroup:
    """The group of ``robot.joint_groups`` that counts for the joint ``name``.

    Errors: :class:`ConfigError` if none matches.
    """
    group = next((g for g in robot.joint_groups if any(part in name for part in g.match)), None)
    if group is None:
        raise ConfigError(f"robot.joint_groups: no group matches joint {name}")
    return group


def build_model(robot: RobotConfig, engine: EngineConfig, table: TableConfig, visual: bool = False) -> mujoco.MjModel:
    """Compile robot, table, floor and the mocap ball: nq = 7 + J, nv = 6 + J, nu = J.

    Args:
        robot: gains, efforts, armature, friction, nominal pose, and the pairs of its geoms that touch each other.
        engine: time step, solver iterations and cone.
        table: size of table, net and paddle.
        visual: keep the geoms that are only for display. The dynamics are the same with and without them;
            physics leaves them out because each costs time in every step.

    Errors: :class:`ConfigError` for gains or a pose that do not fit the robot's joints, for a free hand that the robot
    does not have, and for pairs of ``robot.self_collision`` that the MJCF lacks a geom for, or lists already.
    """
    return compile_scene(describe_scene(robot, engine, table, visual), robot)


def describe_scene(robot: RobotConfig, engine: EngineConfig, table: TableConfig, visual: bool = False) -> mujoco.MjSpec:
    """What :func:`build_model` compiles, with the same arguments and errors; parts can still be added."""
    spec = read_scene(model_path(robot))
    _set_motors(spec, robot)
    _add_groups(spec, robot)
    if robot.self_collision:
        _add_pairs(spec, robot.self_collision)
        _count_the_world_alone(spec)
    _fit_table(spec, table)
    _sense_table(spec, robot.free_hand)
    spec.option.timestep = engine.physics_dt
    spec.option.iterations = engine.solver_iterations
    spec.option.ls_iterations = engine.line_search_iterations
    spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{engine.cone.upper()}")
    if not visual:
        for geom in [g for g in spec.geoms if g.group == VISUAL_GROUP]:
            spec.delete(geom)
    return spec


def compile_scene(spec: mujoco.MjSpec, robot: RobotConfig) -> mujoco.MjModel:
    """The model of ``spec``, with the nominal keyframe of ``robot``.

    Errors: :class:`ConfigError` for a pose that does not fit the robot's joints.
    """
    spec.add_key(name=NOMINAL_KEY)
    model = spec.compile()
    model.key(NOMINAL_KEY).qpos[:] = _standing(model, nominal_pose(robot), robot.foot_sites)
    return model


def _add_groups(spec: mujoco.MjSpec, robot: RobotConfig) -> None:
    """Keep the groups of joints as tuples of the model, for :func:`pace.sim.robot_spec.joints_of`."""
    for group, names in RobotSpec.of(robot).groups.items():
        joint = [int(mujoco.mjtObj.mjOBJ_JOINT)] * len(names)
        spec.add_tuple(name=group, objtype=joint, objname=list(names), objprm=[0.0] * len(names))


def _set_motors(spec: mujoco.MjSpec, robot: RobotConfig) -> None:
    resistances = zip(RobotSpec.of(robot).joints, joint_armature(robot), joint_friction(robot), strict=True)
    for name, armature, friction in resistances:
        spec.joint(name).armature = armature
        spec.joint(name).frictionloss = friction
    for name, (kp, kd, effort) in zip(RobotSpec.of(robot).joints, joint_gains(robot).T, strict=True):
        actuator = spec.actuator(name)
        if robot.stall_ratio:
            _set_line(actuator, kp, kd, joint_group(robot, name).max_speed, robot.stall_ratio * effort)
        else:
            actuator.set_to_position(kp=kp, kv=kd)
        actuator.forcerange = [-effort, effort]


def _add_pairs(spec: mujoco.MjSpec, pairs: Sequence[Sequence[str]]) -> None:
    """List ``pairs`` of geoms as contacts, with the scene's default friction."""
    listed = {frozenset((pair.geomname1, pair.geomname2)) for pair in spec.pairs}
    for pair in pairs:
        for name in pair:
            if spec.geom(name) is None:
                raise ConfigError(f"robot.self_collision: the robot has no geom {name}")
        if frozenset(pair) in listed:
            raise ConfigError(f"robot.self_collision: {' and '.join(pair)} are a pair already")
        listed.add(frozenset(pair))
        spec.add_pair(geomname1=pair[0], geomname2=pair[1])


def _count_the_world_alone(spec: mujoco.MjSpec) -> None:
    """Sensors that count a geom's contacts count those with floor and table, the geoms of the world, and no others.

    A forearm that leans on the trunk is stopped, as on the robot. It is no contact of the kind that the paper's reward
    punishes, a fall or a hit of the table. Counted, for either part, it would cost pretrained/campaign more than its
    successes pay (docs/results/robots.md).
    """
    for sensor in spec.sensors:
        if sensor.name.endswith(TOUCH):
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, "world"


def _set_line(actuator: mujoco.MjsActuator, kp: float, kd: float, speed: float, stall: float) -> None:
    """Make the motor's drive saturate on its torque-speed line; below it the torque is kp (u - q) - kd w, as before.

    MuJoCo's motor of constant K and resistance R gives K (V - K w) / R, and its drive applies the voltage
    V = R / K (kp (u - q) - kd w) + K w, at most Vmax. The voltage is not measured here, so K is 1: then Vmax is the
    no-load speed and 1 / R the slope of the line. No winding inductance: the motor has no state.
    """
    actuator.set_to_dcmotor(
        motorconst=[1.0, 1.0], resistance=speed / stall, controller=[kp, 0.0, kd, 0.0, 0.0, speed], ctrlspec=POSITION
    )


def _fit_table(spec: mujoco.MjSpec, table: TableConfig) -> None:
    """Give table, lines, net and paddle the sizes of ``table``; the ball's physics uses the same numbers."""
    length, width, top = table.length / 2, table.width / 2, table.height
    net, post = table.net_height / 2, width + table.net_overhang
    line, tape, leg = 0.01, 0.0075, (top - table.thickness) / 2  # m: half widths of lines and tape, half a leg
    boxes = {
        "table": ((length, width, table.thickness / 2), (0, 0, top - table.thickness / 2)),
        "line_end_near": ((line, width, 0.0005), (line - length, 0, top)),
        "line_end_far": ((line, width, 0.0005), (length - line, 0, top)),
        "line_side_left": ((length, line, 0.0005), (0, width - line, top)),
        "line_side_right": ((length, line, 0.0005), (0, line - width, top)),
        "line_middle": ((length, 0.0015, 0.0005), (0, 0, top)),
        "net": ((0.003, post, net - tape), (0, 0, top + net - tape)),
        "net_tape": ((0.004, post, tape), (0, 0, top + 2 * net - tape)),
        "post_left": ((0.01, net + 0.015, 0), (0, post + 0.01, top + net - 0.015)),
        "post_right": ((0.01, net + 0.015, 0), (0, -post - 0.01, top + net - 0.015)),
    }
    for x in (-1, 1):
        for y, side in ((1, "left"), (-1, "right")):
            end = "near" if x < 0 else "far"
            boxes[f"leg_{end}_{side}"] = ((0.025, 0.025, leg), (x * (length - 0.32), y * (width - 0.16), leg))
    for name, (size, pos) in boxes.items():
        spec.geom(name).size = size
        spec.geom(name).pos = pos
    spec.geom(PADDLE).size[:2] = (table.paddle_radius, table.paddle_half_thickness)
    for name, side in (("paddle_front", 1), ("paddle_back", -1)):
        geom = spec.geom(name)
        if geom is not None:  # for the eye only; a robot may do without
            geom.size[:2] = (table.paddle_radius - 0.0005, 0.001)
            geom.pos[0] = side * (table.paddle_half_thickness - 0.0007)


def _sense_table(spec: mujoco.MjSpec, free_hand: str) -> None:
    """Append the sensors of :data:`TABLE_FORCES`: net contact forces of the table, world frame."""
    if free_hand and spec.body(free_hand) is None:
        raise ConfigError(f"robot.free_hand: the robot has no body {free_hand}")
    reported = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
    for name in TABLE_FORCES if free_hand else TABLE_FORCES[:1]:
        sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_GEOM, "table"
        if name != TABLE_FORCES[0]:  # the hand's body and all that it carries
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_XBODY, free_hand
        sensor.intprm[:3] = (reported, NET_FORCE, 1)


def _standing(model: mujoco.MjModel, pose: NDArray[np.float64], soles: Sequence[str]) -> NDArray[np.float64]:
    """The state (7 + J,) with joints at ``pose`` and the lowest sole on the floor."""
    data = mujoco.MjData(model)
    data.qpos[7:] = pose
    mujoco.mj_kinematics(model, data)
    data.qpos[2] -= min(data.site(name).xpos[2] for name in soles)
    return data.qpos.copy()
