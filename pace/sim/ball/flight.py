"""One sub-step of a ball among table, net, floor and a moving paddle, as Warp functions.

The ball flies an arc; every surface whose gap closes within it is located by bisection on the arc's cubic Hermite
curve, the ball is flown again to the first of these contacts, and the impulse acts there. So the result depends neither
on the step nor on where in it the contact falls. A contact that goes on (rolling, resting, or squeezed) is settled at
the sub-step's end: no restitution, and the ball stands on the surface.
"""

import warp as wp

from pace.sim.ball.aero import GRAVITY, Air, air_factors, fly
from pace.sim.ball.rebound import Material, box_distance, disc_distance, rebound

NOTHING = wp.constant(-1)
TABLE = wp.constant(0)
NET = wp.constant(1)
FLOOR = wp.constant(2)
PADDLE = wp.constant(3)
#: Surfaces below this number stand still; the forecast meets only these.
STATIC_SURFACES = 3
ALL_SURFACES = 4

#: m, longest way of the ball against a near surface in one sub-step; less than the ball's radius, so none is jumped.
MAX_TRAVEL = 0.015
#: s, shortest sub-step: 150 m/s still stays within MAX_TRAVEL.
MIN_SUBSTEP = 1.0e-4
#: m, a smaller gap counts as touching.
TOUCH = 1.0e-5
#: m/s, slower than this along the normal a touching ball rests; its hop would be 0.1 mm high and last 10 ms.
REST_SPEED = 0.05
#: Contacts that are located within one control step; later ones are settled at the ends of sub-steps.
MAX_LOCATED = 16
BISECTIONS = 22

_FAR = wp.constant(1.0e6)
_NEVER = wp.constant(1.0e6)


@wp.struct
class Body:
    """The ball of one world."""

    radius: wp.float32
    mass: wp.float32
    air: Air
    table: Material
    paddle: Material


@wp.struct
class Scene:
    """What the ball can meet, and the knots of the paddle's path of one control step."""

    table_centre: wp.vec3
    table_half: wp.vec3
    net_centre: wp.vec3
    net_half: wp.vec3
    net: Material
    floor: Material
    paddle_radius: wp.float32
    paddle_half_thickness: wp.float32
    path: wp.array3d[wp.float32]  # (N, S + 1, 12): centre, unit normal, linear and angular velocity
    path_dt: wp.float32  # s between knots


@wp.struct
class Pose:
    """The paddle at one instant."""

    centre: wp.vec3
    normal: wp.vec3
    velocity: wp.vec3
    rotation: wp.vec3  # rad/s


@wp.struct
class Arc:
    """Free flight over one sub-step, from ``clock`` s into the control step on."""

    clock: wp.float32
    duration: wp.float32
    start: wp.vec3
    end: wp.vec3
    start_velocity: wp.vec3
    end_velocity: wp.vec3


@wp.struct
class Contact:
    """The first contact on an arc; ``surface`` is NOTHING where there is none."""

    surface: wp.int32
    time: wp.float32  # s since the arc's start
    lasting: wp.bool  # it goes on: settled at the arc's end


@wp.struct
class Flight:
    """A ball on its way: state, time flown, gap to each surface (m) and how many contacts were located."""

    position: wp.vec3
    velocity: wp.vec3
    spin: wp.vec3
    clock: wp.float32
    gaps: wp.vec4
    located: wp.int32


@wp.struct
class Leg:
    """One sub-step flown: the arc up to the contact, if any, and the contact itself before the impulse."""

    arc: Arc
    surface: wp.int32
    begins: wp.bool  # a new contact, not one that goes on
    normal: wp.vec3
    surface_velocity: wp.vec3


@wp.func
def read_body(params: wp.array2d[wp.float32], world: int) -> Body:
    """The ball of ``world`` from its row of :data:`pace.sim.ball.ball.PARAM_NAMES`."""
    body = Body()
    body.mass = params[world, 0]
    body.radius = params[world, 1]
    body.air = air_factors(params[world, 2], params[world, 3], params[world, 4], body.radius, body.mass)
    body.table.restitution = params[world, 5]
    body.table.slope = params[world, 6]
    body.table.friction = params[world, 7]
    body.paddle.restitution = params[world, 8]
    body.paddle.slope = params[world, 9]
    body.paddle.friction = params[world, 10]
    body.table.lowest = params[world, 11]
    body.paddle.lowest = params[world, 11]
    return body


@wp.func
def _read_vec3(path: wp.array3d[wp.float32], world: int, knot: int, first: int) -> wp.vec3:
    return wp.vec3(path[world, knot, first], path[world, knot, first + 1], path[world, knot, first + 2])


@wp.func
def _hermite(p0: wp.vec3, v0: wp.vec3, p1: wp.vec3, v1: wp.vec3, dt: float, s: float) -> wp.vec3:
    """Cubic through p0, p1 with end velocities v0, v1, at fraction ``s`` of ``dt``."""
    t = 1.0 - s
    return p0 + (s * s * (3.0 - 2.0 * s)) * (p1 - p0) + (s * t * dt) * (t * v0 - s * v1)


@wp.func
def _hermite_velocity(p0: wp.vec3, v0: wp.vec3, p1: wp.vec3, v1: wp.vec3, dt: float, s: float) -> wp.vec3:
    t = 1.0 - s
    return (6.0 * s * t / dt) * (p1 - p0) + (t * (1.0 - 3.0 * s)) * v0 + (s * (3.0 * s - 2.0)) * v1


@wp.func
def arc_position(arc: Arc, time: float) -> wp.vec3:
    """Where the ball is ``time`` s after the arc's start."""
    return _hermite(arc.start, arc.start_velocity, arc.end, arc.end_velocity, arc.duration, time / arc.duration)


@wp.func
def arc_velocity(arc: Arc, time: float) -> wp.vec3:
    """The ball's velocity ``time`` s after the arc's start."""
    return _hermite_velocity(
        arc.start, arc.start_velocity, arc.end, arc.end_velocity, arc.duration, time / arc.duration
    )


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
    return _hermite(
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
    pose.centre = _hermite(p0, v0, p1, v1, scene.path_dt, s)
    pose.velocity = _hermite_velocity(p0, v0, p1, v1, scene.path_dt, s)
    pose.normal = wp.normalize(
        _hermite(n0, _rate(scene, world, knot, 3), n1, _rate(scene, world, knot + 1, 3), scene.path_dt, s)
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


@wp.func
def gap_rate(surface: int, arc: Arc, time: float, radius: float, scene: Scene, world: int) -> float:
    """Rate (m/s) at which the gap opens, ``time`` s after the arc's start; negative when it closes."""
    position = arc_position(arc, time)
    clock = arc.clock + time
    _gap, normal = gap_to(surface, position, clock, radius, scene, world)
    velocity = surface_velocity(surface, position - radius * normal, clock, scene, world)
    return wp.dot(arc_velocity(arc, time) - velocity, normal)


@wp.func
def closing_time(surface: int, arc: Arc, until: float, radius: float, scene: Scene, world: int) -> float:
    """When the gap closes on the arc before ``until`` s, at which it is closed, by bisection."""
    low = wp.float32(0.0)
    high = wp.float32(until)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        gap, _normal = gap_to(surface, arc_position(arc, middle), arc.clock + middle, radius, scene, world)
        if gap > 0.0:
            low = middle
        else:
            high = middle
    return high


@wp.func
def grazing_time(surface: int, arc: Arc, radius: float, scene: Scene, world: int) -> float:
    """When an arc that begins and ends clear of a surface touches it, or _NEVER: the gap's minimum decides."""
    if gap_rate(surface, arc, 0.0, radius, scene, world) >= 0.0:
        return _NEVER
    if gap_rate(surface, arc, arc.duration, radius, scene, world) <= 0.0:
        return _NEVER
    low = wp.float32(0.0)
    high = wp.float32(arc.duration)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if gap_rate(surface, arc, middle, radius, scene, world) < 0.0:
            low = middle
        else:
            high = middle
    gap, _normal = gap_to(surface, arc_position(arc, low), arc.clock + low, radius, scene, world)
    if gap > 0.0:
        return _NEVER
    return closing_time(surface, arc, low, radius, scene, world)


@wp.func
def touching_contact(surface: int, arc: Arc, gap: float, radius: float, scene: Scene, world: int) -> Contact:
    """Contact on an arc that begins on the surface, or inside it, at ``gap`` (m), and ends inside it."""
    contact = Contact()
    contact.surface = surface
    before = gap_rate(surface, arc, 0.0, radius, scene, world)
    if before < -REST_SPEED:
        if gap > 0.0:
            contact.time = closing_time(surface, arc, arc.duration, radius, scene, world)
        return contact  # a paddle that closes in on a ball inside it strikes at once
    if gap_rate(surface, arc, arc.duration, radius, scene, world) >= 0.0:
        contact.surface = NOTHING  # still inside, but on its way out
        return contact
    contact.lasting = before <= REST_SPEED
    contact.time = arc.duration
    if not contact.lasting:
        contact.time = closing_time(surface, arc, arc.duration, radius, scene, world)
    return contact


@wp.func
def contact_with(
    surface: int, arc: Arc, gap: float, end_gap: float, radius: float, scene: Scene, world: int
) -> Contact:
    """The first contact with ``surface`` on an arc over which its gap goes from ``gap`` to ``end_gap`` (m)."""
    contact = Contact()
    contact.surface = NOTHING
    if gap <= TOUCH:
        if end_gap < 0.0:
            return touching_contact(surface, arc, gap, radius, scene, world)
        return contact
    time = wp.float32(_NEVER)
    if end_gap < 0.0:
        time = closing_time(surface, arc, arc.duration, radius, scene, world)
    else:
        time = grazing_time(surface, arc, radius, scene, world)
    if time <= arc.duration:
        contact.surface = surface
        contact.time = time
    return contact


@wp.func
def may_touch(gap: float, end_gap: float, speed: float, duration: float) -> bool:
    """Whether a gap can close within a sub-step at whose ends it is ``gap`` and ``end_gap`` (m)."""
    return end_gap < 0.0 or gap + end_gap < speed * duration


@wp.func
def first_contact(
    arc: Arc,
    gaps: wp.vec4,
    end_gaps: wp.vec4,
    speed: float,
    paddle_speed: float,
    radius: float,
    scene: Scene,
    world: int,
) -> Contact:
    """The earliest contact on an arc; ``speed`` bounds the ball's, ``paddle_speed`` the paddle's (m/s)."""
    first = Contact()
    first.surface = NOTHING
    first.time = 2.0 * arc.duration
    for surface in range(ALL_SURFACES):
        relative = wp.float32(speed)
        if surface == PADDLE:
            relative += paddle_speed
        gap = gaps[surface]
        end_gap = end_gaps[surface]
        if may_touch(gap, end_gap, relative, arc.duration):
            contact = contact_with(surface, arc, gap, end_gap, radius, scene, world)
            if contact.surface != NOTHING and contact.time < first.time:
                first = contact
    return first


@wp.func
def substep_length(gaps: wp.vec4, speed: float, paddle_speed: float, remaining: float, longest: float) -> float:
    """Length (s) of the next sub-step: at most ``longest``, and no further than the nearest surface or MAX_TRAVEL."""
    still = wp.min(gaps[TABLE], wp.min(gaps[NET], gaps[FLOOR]))
    step = wp.min(longest, wp.max(still, MAX_TRAVEL) / speed)
    step = wp.min(step, wp.max(gaps[PADDLE], MAX_TRAVEL) / (speed + paddle_speed))
    return remaining / wp.ceil(remaining / wp.max(step, MIN_SUBSTEP))


@wp.func
def material_of(surface: int, body: Body, scene: Scene) -> Material:
    """Contact material of the ball with ``surface``."""
    if surface == TABLE:
        return body.table
    if surface == NET:
        return scene.net
    if surface == FLOOR:
        return scene.floor
    return body.paddle


@wp.func
def settle(flight: Flight, contact: Contact, surfaces: int, body: Body, scene: Scene, world: int):
    """The flight after the impulse of ``contact``, at which ``flight`` has arrived; normal and surface velocity there.

    A lasting contact gives nothing back, and the ball stands on the surface.
    """
    gap, normal = gap_to(contact.surface, flight.position, flight.clock, body.radius, scene, world)
    point = flight.position - body.radius * normal
    velocity = surface_velocity(contact.surface, point, flight.clock, scene, world)
    material = material_of(contact.surface, body, scene)
    after = Flight()
    after.position = flight.position
    after.located = flight.located + 1
    if contact.lasting:
        material.restitution = 0.0
        material.lowest = 0.0
        after.position = flight.position - wp.min(gap, 0.0) * normal
        after.located = flight.located
    after_velocity, after_spin = rebound(flight.velocity, flight.spin, normal, velocity, body.radius, material)
    after.velocity = after_velocity
    after.spin = after_spin
    after.clock = flight.clock
    after.gaps = gaps_to(surfaces, after.position, after.clock, body.radius, scene, world)
    return after, normal, velocity


@wp.func
def fly_leg(
    flight: Flight,
    surfaces: int,
    paddle_speed: float,
    remaining: float,
    longest: float,
    body: Body,
    scene: Scene,
    world: int,
):
    """Fly one sub-step of at most ``longest`` and ``remaining`` s, or less where a contact comes first.

    Returns the flight after it, impulse included, and the leg that was flown.
    """
    speed = wp.length(flight.velocity) + GRAVITY * longest
    arc = Arc()
    arc.clock = flight.clock
    arc.duration = substep_length(flight.gaps, speed, paddle_speed, remaining, longest)
    arc.start = flight.position
    arc.start_velocity = flight.velocity
    end, end_velocity = fly(flight.position, flight.velocity, flight.spin, body.air, arc.duration)
    arc.end = end
    arc.end_velocity = end_velocity
    end_gaps = gaps_to(surfaces, arc.end, arc.clock + arc.duration, body.radius, scene, world)
    contact = Contact()
    contact.surface = NOTHING
    still = wp.min(flight.gaps[TABLE] + end_gaps[TABLE], flight.gaps[NET] + end_gaps[NET])
    still = wp.min(still, flight.gaps[FLOOR] + end_gaps[FLOOR])
    moving = flight.gaps[PADDLE] + end_gaps[PADDLE]
    if still < speed * arc.duration or moving < (speed + paddle_speed) * arc.duration:
        contact = first_contact(arc, flight.gaps, end_gaps, speed, paddle_speed, body.radius, scene, world)
    leg = Leg()
    leg.surface = contact.surface
    if contact.surface != NOTHING:
        contact.lasting = contact.lasting or flight.located >= MAX_LOCATED
        leg.begins = not contact.lasting
        if leg.begins:
            arc.duration = contact.time
            end, end_velocity = fly(flight.position, flight.velocity, flight.spin, body.air, arc.duration)
            arc.end = end
            arc.end_velocity = end_velocity
    leg.arc = arc
    after = Flight()
    after.position = arc.end
    after.velocity = arc.end_velocity
    after.spin = flight.spin
    after.clock = flight.clock + arc.duration
    after.gaps = end_gaps
    after.located = flight.located
    if contact.surface != NOTHING:
        after, normal, velocity = settle(after, contact, surfaces, body, scene, world)
        leg.normal = normal
        leg.surface_velocity = velocity
    return after, leg
