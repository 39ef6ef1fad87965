"""The air on a flying ball, as Warp functions: drag, Magnus force, and one Runge-Kutta step of flight.

Forces: ``-1/2 rho C_d A |v| v`` and ``1/2 rho A r C_m (omega x v) + C_M rho V (omega x v)`` with A = pi r^2 and
V = 4/3 pi r^3. C_d is a constant plus a share of a measured table of speed and spin ratio S = r |omega| / |v|; the lift
is a constant C_m plus a share of a measured C_M of speed and spin. Sources in ``configs/ball/``.
Spin is constant in flight: a serve lasts about one second, and the air's torque is not modelled.
"""

import warp as wp

#: m/s^2, downwards; the value of the robot's MuJoCo model.
GRAVITY = 9.81
#: m/s; where half a step changes the speed by less, its second middle stage takes the first one's factors of the air.
LEAST_CHANGE = 1.0e-3

_GRAVITY_VECTOR = wp.constant(wp.vec3(0.0, 0.0, -GRAVITY))


@wp.struct
class AirTables:
    """Measured coefficients, rows of increasing speed; :func:`pace.sim.ball.air_tables.air_tables` makes them."""

    drag: wp.array2d[wp.float32]  # (rows, 1 + 2 K): speed m/s, K spin ratios, C_d at each
    lift: wp.array2d[wp.float32]  # (rows, 7): speed m/s, slope, offset, bend rad/s, and the parabola above it


@wp.struct
class Air:
    """Aerodynamic factors of one ball, per unit of mass."""

    radius: wp.float32  # m
    drag: wp.float32  # 1/m: a = -drag |v| v
    magnus: wp.float32  # 1: a = magnus (omega x v)
    table_drag: wp.float32  # 1/m, times C_d of the table
    table_lift: wp.float32  # 1, times C_M of the table


@wp.func
def air_factors(
    density: float,
    drag_coefficient: float,
    magnus_coefficient: float,
    table_drag: float,
    table_lift: float,
    radius: float,
    mass: float,
) -> Air:
    """Factors of a ball of ``radius`` m and ``mass`` kg in air of ``density`` kg/m^3."""
    per_mass = 0.5 * density * wp.pi * radius * radius / mass
    air = Air()
    air.radius = radius
    air.drag = per_mass * drag_coefficient
    air.magnus = per_mass * radius * magnus_coefficient
    air.table_drag = per_mass * table_drag
    air.table_lift = (8.0 / 3.0) * per_mass * radius * table_lift
    return air


@wp.func
def row_below(table: wp.array2d[wp.float32], speed: float) -> int:
    """The row below ``speed`` m/s; the first below all rows, the last but one above them."""
    row = wp.int32(0)
    while row < table.shape[0] - 2 and speed > table[row + 1, 0]:
        row += 1
    return row


@wp.func
def _drag_in_row(table: wp.array2d[wp.float32], row: int, ratio: float) -> float:
    """C_d of a row at a spin ratio: linear between the knots, held beyond them."""
    knots = (table.shape[1] - 1) / 2
    knot = wp.int32(0)
    while knot < knots - 2 and ratio > table[row, 2 + knot]:
        knot += 1
    low = table[row, 1 + knot]
    share = wp.clamp((ratio - low) / (table[row, 2 + knot] - low), 0.0, 1.0)
    return wp.lerp(table[row, 1 + knots + knot], table[row, 2 + knots + knot], share)


@wp.func
def measured_drag(table: wp.array2d[wp.float32], speed: float, ratio: float) -> float:
    """C_d at ``speed`` m/s: linear between the rows, held below them, extrapolated above them, never negative."""
    row = row_below(table, speed)
    share = wp.max((speed - table[row, 0]) / (table[row + 1, 0] - table[row, 0]), 0.0)
    return wp.max(wp.lerp(_drag_in_row(table, row, ratio), _drag_in_row(table, row + 1, ratio), share), 0.0)


@wp.func
def _lift_in_row(table: wp.array2d[wp.float32], row: int, turning: float) -> float:
    """C_M of a row at a spin of ``turning`` rad/s: a line up to the bend, a parabola above it, never negative."""
    lift = table[row, 1] * turning + table[row, 2]
    if turning > table[row, 3]:
        lift = (table[row, 4] * turning + table[row, 5]) * turning + table[row, 6]
    return wp.max(lift, 0.0)


@wp.func
def measured_lift(table: wp.array2d[wp.float32], speed: float, turning: float) -> float:
    """C_M at ``speed`` m/s and a spin of ``turning`` rad/s: linear between the rows, held beyond them."""
    row = row_below(table, speed)
    share = wp.clamp((speed - table[row, 0]) / (table[row + 1, 0] - table[row, 0]), 0.0, 1.0)
    return wp.lerp(_lift_in_row(table, row, turning), _lift_in_row(table, row + 1, turning), share)


@wp.func
def drag_and_lift(speed: float, turning: float, air: Air, tables: AirTables) -> wp.vec2:
    """Factors of drag (1/m) and Magnus force (1) at ``speed`` m/s and a spin of ``turning`` rad/s."""
    factors = wp.vec2(air.drag, air.magnus)
    if air.table_drag > 0.0:
        factors[0] += air.table_drag * measured_drag(tables.drag, speed, air.radius * turning / wp.max(speed, 1.0e-3))
    if air.table_lift > 0.0 and turning > 0.0:
        factors[1] += air.table_lift * measured_lift(tables.lift, speed, turning)
    return factors


@wp.func
def acceleration(velocity: wp.vec3, spin: wp.vec3, speed: float, factors: wp.vec2) -> wp.vec3:
    """Acceleration (m/s^2) of a ball at ``velocity`` m/s with ``spin`` rad/s: gravity, drag and Magnus force."""
    return _GRAVITY_VECTOR - (factors[0] * speed) * velocity + factors[1] * wp.cross(spin, velocity)


@wp.func
def fly(position: wp.vec3, velocity: wp.vec3, spin: wp.vec3, air: Air, tables: AirTables, dt: float):
    """Position and velocity after ``dt`` s of free flight: one classical Runge-Kutta step of fourth order.

    The second of both middle stages takes the factors of the air on the line through those of the stages before, not
    from the tables: each look-up costs as much as a stage.
    """
    half = 0.5 * dt
    turning = wp.length(spin)
    speed = wp.length(velocity)
    first = drag_and_lift(speed, turning, air, tables)
    a1 = acceleration(velocity, spin, speed, first)
    v2 = velocity + half * a1
    speed2 = wp.length(v2)
    middle = drag_and_lift(speed2, turning, air, tables)
    a2 = acceleration(v2, spin, speed2, middle)
    v3 = velocity + half * a2
    speed3 = wp.length(v3)
    along = 0.0
    if wp.abs(speed2 - speed) > LEAST_CHANGE:
        along = (speed3 - speed2) / (speed2 - speed)
    a3 = acceleration(v3, spin, speed3, middle + along * (middle - first))
    v4 = velocity + dt * a3
    speed4 = wp.length(v4)
    a4 = acceleration(v4, spin, speed4, drag_and_lift(speed4, turning, air, tables))
    sixth = dt / 6.0
    return (
        position + sixth * (velocity + 2.0 * (v2 + v3) + v4),
        velocity + sixth * (a1 + 2.0 * (a2 + a3) + a4),
    )
