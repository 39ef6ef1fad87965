"""The moving paddle between the knots of its path, as Warp functions."""

import warp as wp

from pace.sim.ball.arc import hermite, hermite_velocity
from pace.sim.ball.scene import Scene


@wp.struct
class Pose:
    """The paddle at one instant."""

    centre: wp.vec3
    normal: wp.vec3
    velocity: wp.vec3
    rotation: wp.vec3  # rad/s


@wp.func
def _read_vec3(path: wp.array3d[wp.float32], world: int, knot: int, first: int) -> wp.vec3:
    return wp.vec3(path[world, knot, first], path[world, knot, first + 1], path[world, knot, first + 2])


@wp.func
def _rate(scene: Scene, world: int, knot: int, first: int) -> wp.vec3:
    """Rate of the centre (``first`` 0) or normal (3) at a knot, from the parabola through it and its neighbours.

    An engine's velocities are those of half a physics step before its positions (semi-implicit Euler). A cubic through
    both would swing about the motion by 0.2 m/s within a step of 10 ms. They serve only where there are no three knots.
    """
    last = scene.path.shape[1] - 1
    if last < 2:
        if first == 0:
            return _read_vec3(scene.path, world, knot, 6)
        return wp.cross(_read_vec3(scene.path, world, knot, 9), _read_vec3(scene.path, world, knot, 3))
    middle = wp.clamp(knot, 1, last - 1)
    before = _read_vec3(scene.path, world, middle - 1, first)
    after = _read_vec3(scene.path, world, middle + 1, first)
    bend = before - 2.0 * _read_vec3(scene.path, world, middle, first) + after
    return (0.5 * (after - before) + float(knot - middle) * bend) / scene.path_dt


@wp.func
def paddle_centre(scene: Scene, world: int, clock: float) -> wp.vec3:
    """Centre of the paddle ``clock`` s into the control step."""
    knot = wp.clamp(int(clock / scene.path_dt), 0, scene.path.shape[1] - 2)
    return hermite(
        _read_vec3(scene.path, world, knot, 0),
        _rate(scene, world, knot, 0),
        _read_vec3(scene.path, world, knot + 1, 0),
        _rate(scene, world, knot + 1, 0),
        scene.path_dt,
        clock / scene.path_dt - float(knot),
    )


@wp.func
def paddle_pose(scene: Scene, world: int, clock: float) -> Pose:
    """The paddle ``clock`` s into the control step. Its velocity is the derivative of the interpolated centre."""
    knot = wp.clamp(int(clock / scene.path_dt), 0, scene.path.shape[1] - 2)
    s = clock / scene.path_dt - float(knot)
    p0 = _read_vec3(scene.path, world, knot, 0)
    p1 = _read_vec3(scene.path, world, knot + 1, 0)
    v0 = _rate(scene, world, knot, 0)
    v1 = _rate(scene, world, knot + 1, 0)
    n0 = _read_vec3(scene.path, world, knot, 3)
    n1 = _read_vec3(scene.path, world, knot + 1, 3)
    pose = Pose()
    pose.centre = hermite(p0, v0, p1, v1, scene.path_dt, s)
    pose.velocity = hermite_velocity(p0, v0, p1, v1, scene.path_dt, s)
    pose.normal = wp.normalize(
        hermite(n0, _rate(scene, world, knot, 3), n1, _rate(scene, world, knot + 1, 3), scene.path_dt, s)
    )
    pose.rotation = wp.lerp(_read_vec3(scene.path, world, knot, 9), _read_vec3(scene.path, world, knot + 1, 9), s)
    return pose


@wp.func
def paddle_speed_bound(scene: Scene, world: int) -> float:
    """No point of the paddle moves faster (m/s) during this control step."""
    fastest = wp.float32(0.0)
    for knot in range(scene.path.shape[1] - 1):
        p0 = _read_vec3(scene.path, world, knot, 0)
        p1 = _read_vec3(scene.path, world, knot + 1, 0)
        knots = wp.max(wp.length(_rate(scene, world, knot, 0)), wp.length(_rate(scene, world, knot + 1, 0)))
        turning = wp.max(
            wp.length(_read_vec3(scene.path, world, knot, 9)), wp.length(_read_vec3(scene.path, world, knot + 1, 9))
        )
        # 3/2 chord + 1/2 end velocity bounds the derivative of the cubic between the ends.
        middle = 1.5 * wp.length(p1 - p0) / scene.path_dt + 0.5 * knots
        fastest = wp.max(fastest, wp.max(knots, middle) + turning * scene.paddle_radius)
    return fastest
