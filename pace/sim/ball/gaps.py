"""Gaps between the ball and the surfaces, and the velocities of the surfaces, as Warp functions."""

import warp as wp

from pace.sim.ball.aero import GRAVITY
from pace.sim.ball.paddle import paddle_centre, paddle_pose
from pace.sim.ball.rebound import box_distance, disc_distance
from pace.sim.ball.robot_body import body_velocity, nearest_shape
from pace.sim.ball.scene import ALL_SURFACES, BODY, FLOOR, NET, PADDLE, STATIC_SURFACES, Gaps, Scene

_FAR = wp.constant(1.0e6)


@wp.func
def reachable_surfaces(
    position: wp.vec3, speed: float, paddle_speed: float, duration: float, radius: float, scene: Scene, world: int
) -> int:
    """How many surfaces the ball can meet within ``duration`` s from the path's start on: a far robot is left out, and
    a far paddle."""
    if scene.robot.near_count[world] > 0:
        return ALL_SURFACES
    size = scene.paddle_radius + scene.paddle_half_thickness + radius
    gap = wp.length(position - paddle_centre(scene, world, 0.0)) - size
    if gap > (speed + GRAVITY * duration + paddle_speed) * duration:
        return STATIC_SURFACES
    return PADDLE + 1


@wp.func
def gap_to(surface: int, position: wp.vec3, clock: float, radius: float, scene: Scene, world: int):
    """Gap (m, negative inside) between the ball and a surface, and the unit normal from the surface to the ball."""
    if surface <= NET:  # one of the two boxes
        centre = scene.table_centre
        half = scene.table_half
        if surface == NET:
            centre = scene.net_centre
            half = scene.net_half
        distance, normal = box_distance(position, centre, half)
        return distance - radius, normal
    if surface == FLOOR:
        return position[2] - radius, wp.vec3(0.0, 0.0, 1.0)
    if surface == BODY:
        nearest = nearest_shape(scene.robot, world, position, clock, scene.path_dt)
        return nearest.distance - radius, nearest.normal
    pose = paddle_pose(scene, world, clock)
    distance, normal = disc_distance(
        position - pose.centre, pose.normal, scene.paddle_radius, scene.paddle_half_thickness
    )
    return distance - radius, normal


@wp.func
def gaps_to(surfaces: int, position: wp.vec3, clock: float, radius: float, scene: Scene, world: int) -> Gaps:
    """Gaps to the first ``surfaces`` surfaces; paddle and body are far if they are not among them."""
    table, _table_normal = box_distance(position, scene.table_centre, scene.table_half)
    net, _net_normal = box_distance(position, scene.net_centre, scene.net_half)
    gaps = Gaps(table - radius, net - radius, position[2] - radius, _FAR, _FAR)
    if surfaces > PADDLE:
        gap, _normal = gap_to(PADDLE, position, clock, radius, scene, world)
        gaps[PADDLE] = gap
    if surfaces > BODY:
        nearest = nearest_shape(scene.robot, world, position, clock, scene.path_dt)
        gaps[BODY] = nearest.distance - radius
    return gaps


@wp.func
def surface_velocity(surface: int, point: wp.vec3, clock: float, scene: Scene, world: int) -> wp.vec3:
    """Velocity (m/s) of the surface at ``point``; of the body, of its shape that is nearest to it."""
    if surface < STATIC_SURFACES:
        return wp.vec3(0.0, 0.0, 0.0)
    if surface == BODY:
        nearest = nearest_shape(scene.robot, world, point, clock, scene.path_dt)
        return body_velocity(scene.robot, world, nearest.shape, point, clock, scene.path_dt)
    pose = paddle_pose(scene, world, clock)
    return pose.velocity + wp.cross(pose.rotation, point - pose.centre)
