"""Gaps between the ball and the surfaces, and the velocities of the surfaces, as Warp functions."""

import warp as wp

from pace.sim.ball.aero import GRAVITY
from pace.sim.ball.paddle import paddle_centre, paddle_pose
from pace.sim.ball.rebound import box_distance, disc_distance
from pace.sim.ball.scene import ALL_SURFACES, FLOOR, NET, PADDLE, STATIC_SURFACES, TABLE, Scene

_FAR = wp.constant(1.0e6)


@wp.func
def reachable_surfaces(
    position: wp.vec3, speed: float, paddle_speed: float, duration: float, radius: float, scene: Scene, world: int
) -> int:
    """How many surfaces the ball can meet within ``duration`` s from the path's start on: a far paddle is left out."""
    size = scene.paddle_radius + scene.paddle_half_thickness + radius
    gap = wp.length(position - paddle_centre(scene, world, 0.0)) - size
    if gap > (speed + GRAVITY * duration + paddle_speed) * duration:
        return STATIC_SURFACES
    return ALL_SURFACES


@wp.func
def gap_to(surface: int, position: wp.vec3, clock: float, radius: float, scene: Scene, world: int):
    """Gap (m, negative inside) between the ball and a surface, and the unit normal from the surface to the ball."""
    if surface == TABLE:
        distance, normal = box_distance(position, scene.table_centre, scene.table_half)
        return distance - radius, normal
    if surface == NET:
        distance, normal = box_distance(position, scene.net_centre, scene.net_half)
        return distance - radius, normal
    if surface == FLOOR:
        return position[2] - radius, wp.vec3(0.0, 0.0, 1.0)
    pose = paddle_pose(scene, world, clock)
    distance, normal = disc_distance(
        position - pose.centre, pose.normal, scene.paddle_radius, scene.paddle_half_thickness
    )
    return distance - radius, normal


@wp.func
def gaps_to(surfaces: int, position: wp.vec3, clock: float, radius: float, scene: Scene, world: int) -> wp.vec4:
    """Gaps to the first ``surfaces`` surfaces; a paddle that is not among them is far."""
    table, _table_normal = box_distance(position, scene.table_centre, scene.table_half)
    net, _net_normal = box_distance(position, scene.net_centre, scene.net_half)
    gaps = wp.vec4(table - radius, net - radius, position[2] - radius, _FAR)
    if surfaces > PADDLE:
        gap, _normal = gap_to(PADDLE, position, clock, radius, scene, world)
        gaps[PADDLE] = gap
    return gaps


@wp.func
def surface_velocity(surface: int, point: wp.vec3, clock: float, scene: Scene, world: int) -> wp.vec3:
    """Velocity (m/s) of the surface at ``point``."""
    if surface != PADDLE:
        return wp.vec3(0.0, 0.0, 0.0)
    pose = paddle_pose(scene, world, clock)
    return pose.velocity + wp.cross(pose.rotation, point - pose.centre)
