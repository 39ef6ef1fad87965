"""A free flight over one sub-step as the cubic Hermite curve through its ends, as Warp functions."""

import warp as wp


@wp.struct
class Arc:
    """Free flight over one sub-step, from ``clock`` s into the control step on."""

    clock: wp.float32
    duration: wp.float32
    start: wp.vec3
    end: wp.vec3
    start_velocity: wp.vec3
    end_velocity: wp.vec3


@wp.func
def hermite(p0: wp.vec3, v0: wp.vec3, p1: wp.vec3, v1: wp.vec3, dt: float, s: float) -> wp.vec3:
    """Cubic through p0, p1 with end velocities v0, v1, at fraction ``s`` of ``dt``."""
    t = 1.0 - s
    return p0 + (s * s * (3.0 - 2.0 * s)) * (p1 - p0) + (s * t * dt) * (t * v0 - s * v1)


@wp.func
def hermite_velocity(p0: wp.vec3, v0: wp.vec3, p1: wp.vec3, v1: wp.vec3, dt: float, s: float) -> wp.vec3:
    t = 1.0 - s
    return (6.0 * s * t / dt) * (p1 - p0) + (t * (1.0 - 3.0 * s)) * v0 + (s * (3.0 * s - 2.0)) * v1


@wp.func
def arc_position(arc: Arc, time: float) -> wp.vec3:
    """Where the ball is ``time`` s after the arc's start."""
    return hermite(arc.start, arc.start_velocity, arc.end, arc.end_velocity, arc.duration, time / arc.duration)


@wp.func
def arc_velocity(arc: Arc, time: float) -> wp.vec3:
    """The ball's velocity ``time`` s after the arc's start."""
    return hermite_velocity(arc.start, arc.start_velocity, arc.end, arc.end_velocity, arc.duration, time / arc.duration)
