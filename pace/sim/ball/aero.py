"""The air on a flying ball, as Warp functions: quadratic drag, Magnus force, and one Runge-Kutta step of flight.

Force: ``F = -1/2 rho C_d A |v| v + 1/2 rho A r C_m (omega x v)`` with A = pi r^2; sources in ``configs/ball/``.
Spin is constant in flight: a serve lasts about one second, and the air's torque is not modelled.
"""

import warp as wp

#: m/s^2, downwards; the value of the robot's MuJoCo model.
GRAVITY = 9.81

_GRAVITY_VECTOR = wp.constant(wp.vec3(0.0, 0.0, -GRAVITY))


@wp.struct
class Air:
    """Aerodynamic factors of one ball, per unit of mass."""

    drag: wp.float32  # 1/m: a = -drag |v| v
    magnus: wp.float32  # 1: a = magnus (omega x v)


@wp.func
def air_factors(density: float, drag_coefficient: float, magnus_coefficient: float, radius: float, mass: float) -> Air:
    """Factors of a ball of ``radius`` m and ``mass`` kg in air of ``density`` kg/m^3."""
    per_mass = 0.5 * density * wp.pi * radius * radius / mass
    air = Air()
    air.drag = per_mass * drag_coefficient
    air.magnus = per_mass * radius * magnus_coefficient
    return air


@wp.func
def acceleration(velocity: wp.vec3, spin: wp.vec3, air: Air) -> wp.vec3:
    """Acceleration (m/s^2) of a ball at ``velocity`` m/s with ``spin`` rad/s: gravity, drag and Magnus force."""
    return _GRAVITY_VECTOR - (air.drag * wp.length(velocity)) * velocity + air.magnus * wp.cross(spin, velocity)


@wp.func
def fly(position: wp.vec3, velocity: wp.vec3, spin: wp.vec3, air: Air, dt: float):
    """Position and velocity after ``dt`` s of free flight: one classical Runge-Kutta step of fourth order."""
    half = 0.5 * dt
    a1 = acceleration(velocity, spin, air)
    v2 = velocity + half * a1
    a2 = acceleration(v2, spin, air)
    v3 = velocity + half * a2
    a3 = acceleration(v3, spin, air)
    v4 = velocity + dt * a3
    a4 = acceleration(v4, spin, air)
    sixth = dt / 6.0
    return (
        position + sixth * (velocity + 2.0 * (v2 + v3) + v4),
        velocity + sixth * (a1 + 2.0 * (a2 + a3) + a4),
    )
