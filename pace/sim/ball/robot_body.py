"""The robot's body as a surface for the ball: rigid shapes that move with its links, as Warp functions.

A shape is a box with rounded edges, which is a sphere if its half sizes are zero and a capsule if two of them are, or a
cylinder: for both the distance is a closed form. Between two instants of a control step a link's origin moves on a
straight line and its rotation along the shortest way. That is off by a dt^2 / 8, a the acceleration and dt the time
between the instants. Measured on 16 robots of ``pretrained/campaign`` in 3 s of play, dt = 10 ms: 0.1 mm (median), 2 mm
(largest, forearms), 4 mm (largest, feet that come down).
"""

import warp as wp

from pace.sim.ball.rebound import box_distance, disc_distance

_FAR = wp.constant(1.0e6)


@wp.struct
class RobotBody:
    """G shapes of N robots, by link; S + 1 instants of the control step that the ball flies next.

    Only the shapes that the ball may meet in it are posed, the first ``near_count`` of ``near``.
    """

    link: wp.array[wp.int32]  # (G,) row of position and rotation
    centre: wp.array[wp.vec3]  # (G,) m, in the link's frame
    rotation: wp.array[wp.quat]  # (G,) of the shape's frame in the link's frame
    half: wp.array[wp.vec3]  # (G,) m, half sizes of the box without its rounding; of a cylinder: radius, -, half length
    rounding: wp.array[wp.float32]  # (G,) m; negative: a cylinder along the shape's z axis
    reach: wp.array[wp.float32]  # (G,) m, radius of a sphere about the centre that holds the shape
    hand: wp.array[wp.bool]  # (G,) of the hand that holds the paddle
    link_position: wp.array3d[wp.vec3]  # (N, S + 1, L) m, world frame
    link_rotation: wp.array3d[wp.quat]  # (N, S + 1, L)
    near: wp.array2d[wp.int32]  # (N, G) shapes
    near_count: wp.array[wp.int32]  # (N,)
    speed: wp.array[wp.float32]  # (N,) m/s; no point of the near shapes moves faster


@wp.struct
class LinkPose:
    """A link at one instant, world frame."""

    position: wp.vec3
    rotation: wp.quat
    velocity: wp.vec3  # m/s, of its origin
    turning: wp.vec3  # rad/s


@wp.struct
class Nearest:
    """The nearest of the near shapes to a point; ``shape`` is -1 and ``distance`` large if there is none."""

    shape: wp.int32
    distance: wp.float32  # m, negative inside
    normal: wp.vec3  # unit vector from the shape to the point


@wp.func
def turning_between(start: wp.quat, end: wp.quat, duration: float) -> wp.vec3:
    """Angular velocity (rad/s), world frame, of a small rotation from ``start`` to ``end``: off by the angle's cube."""
    turn = end * wp.quat_inverse(start)
    return (2.0 / duration) * wp.vec3(turn[0], turn[1], turn[2])


@wp.func
def link_pose(body: RobotBody, world: int, link: int, clock: float, path_dt: float) -> LinkPose:
    """A link ``clock`` s into the control step; ``path_dt`` s lie between its instants."""
    knot = wp.clamp(int(clock / path_dt), 0, body.link_position.shape[1] - 2)
    share = clock / path_dt - float(knot)
    p0 = body.link_position[world, knot, link]
    p1 = body.link_position[world, knot + 1, link]
    q0 = body.link_rotation[world, knot, link]
    q1 = body.link_rotation[world, knot + 1, link]
    pose = LinkPose()
    pose.position = p0 + share * (p1 - p0)
    pose.rotation = wp.normalize(q0 * (1.0 - share) + q1 * share)
    pose.velocity = (p1 - p0) / path_dt
    pose.turning = turning_between(q0, q1, path_dt)
    return pose


@wp.func
def shape_distance(point: wp.vec3, half: wp.vec3, rounding: float):
    """Signed distance (m) and outward normal at ``point``, in the shape's frame."""
    if rounding < 0.0:
        return disc_distance(point, wp.vec3(0.0, 0.0, 1.0), half[0], half[2])
    distance, normal = box_distance(point, wp.vec3(0.0, 0.0, 0.0), half)
    return distance - rounding, normal


@wp.func
def nearest_shape(body: RobotBody, world: int, point: wp.vec3, clock: float, path_dt: float) -> Nearest:
    """The near shape that ``point`` is nearest to, ``clock`` s into the control step."""
    nearest = Nearest()
    nearest.shape = -1
    nearest.distance = _FAR
    for i in range(body.near_count[world]):
        shape = body.near[world, i]
        pose = link_pose(body, world, body.link[shape], clock, path_dt)
        offset = wp.quat_rotate_inv(pose.rotation, point - pose.position) - body.centre[shape]
        if wp.length(offset) - body.reach[shape] < nearest.distance:
            turn = body.rotation[shape]
            local = wp.quat_rotate_inv(turn, offset)
            distance, normal = shape_distance(local, body.half[shape], body.rounding[shape])
            if distance < nearest.distance:
                nearest.shape = shape
                nearest.distance = distance
                nearest.normal = wp.quat_rotate(pose.rotation, wp.quat_rotate(turn, normal))
    return nearest


@wp.func
def body_velocity(body: RobotBody, world: int, shape: int, point: wp.vec3, clock: float, path_dt: float) -> wp.vec3:
    """Velocity (m/s) of the point of a shape that is at ``point``; a ball that is not finite may meet no shape (-1)."""
    if shape < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    pose = link_pose(body, world, body.link[shape], clock, path_dt)
    return pose.velocity + wp.cross(pose.turning, point - pose.position)
