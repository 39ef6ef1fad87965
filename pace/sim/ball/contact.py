"""The first contact of a ball on an arc, located by bisection, as Warp functions.

A GPU's compiler copies a function into every place that calls it. So each of them is called in as few places as
possible, for all kinds of contact and all surfaces: with one place for each, a kernel took minutes to compile.
"""

import warp as wp

from pace.sim.ball.arc import Arc, arc_position, arc_velocity
from pace.sim.ball.gaps import gap_to, surface_velocity
from pace.sim.ball.scene import BODY, FLOOR, NET, NOTHING, PADDLE, TABLE, Gaps, Scene

#: m, a smaller gap counts as touching.
TOUCH = 1.0e-5
#: m/s, slower than this along the normal a touching ball rests; its hop would be 0.1 mm high and last 10 ms.
REST_SPEED = 0.05
BISECTIONS = 22


@wp.struct
class Contact:
    """The first contact on an arc; ``surface`` is NOTHING where there is none."""

    surface: wp.int32
    time: wp.float32  # s since the arc's start
    lasting: wp.bool  # it goes on: settled at the arc's end


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
def nearest_time(surface: int, arc: Arc, radius: float, scene: Scene, world: int) -> float:
    """When the gap is smallest on an arc that begins approaching and ends receding, by bisection."""
    low = wp.float32(0.0)
    high = wp.float32(arc.duration)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if gap_rate(surface, arc, middle, radius, scene, world) < 0.0:
            low = middle
        else:
            high = middle
    return low


@wp.func
def closed_at(surface: int, arc: Arc, gap: float, end_gap: float, radius: float, scene: Scene, world: int) -> Contact:
    """A time on the arc at which the gap is closed, and before which it closes once, as a :class:`Contact`.

    The arc begins clear of the surface and ends inside it; or begins and ends clear of it, and the gap's minimum
    decides; or begins on the surface, or inside it, at ``gap`` (m), and ends inside it.
    """
    contact = Contact()
    contact.surface = NOTHING
    contact.time = arc.duration
    touching = gap <= TOUCH
    inside = end_gap < 0.0
    if touching != inside:
        if inside:
            contact.surface = surface
        return contact
    before = gap_rate(surface, arc, 0.0, radius, scene, world)
    if touching and before < -REST_SPEED:
        contact.surface = surface
        if gap <= 0.0:
            contact.time = 0.0  # a paddle that closes in on a ball inside it strikes at once
        return contact
    if not touching and before >= 0.0:
        return contact
    after = gap_rate(surface, arc, arc.duration, radius, scene, world)
    if touching:
        if after >= 0.0:
            return contact  # still inside, but on its way out
        contact.lasting = before <= REST_SPEED
    else:
        if after <= 0.0:
            return contact
        time = nearest_time(surface, arc, radius, scene, world)
        least, _normal = gap_to(surface, arc_position(arc, time), arc.clock + time, radius, scene, world)
        contact.time = time
        if least > 0.0:
            return contact
    contact.surface = surface
    return contact


@wp.func
def contact_with(
    surface: int, arc: Arc, gap: float, end_gap: float, radius: float, scene: Scene, world: int
) -> Contact:
    """The first contact with ``surface`` on an arc over which its gap goes from ``gap`` to ``end_gap`` (m)."""
    contact = closed_at(surface, arc, gap, end_gap, radius, scene, world)
    if contact.surface != NOTHING and not contact.lasting and contact.time > 0.0:
        contact.time = closing_time(surface, arc, contact.time, radius, scene, world)
    return contact


@wp.func
def may_touch(gap: float, end_gap: float, speed: float, duration: float) -> bool:
    """Whether a gap can close within a sub-step at whose ends it is ``gap`` and ``end_gap`` (m)."""
    return end_gap < 0.0 or gap + end_gap < speed * duration


@wp.func
def first_contact(
    arc: Arc,
    gaps: Gaps,
    end_gaps: Gaps,
    surfaces: int,
    speed: float,
    robot_speed: float,
    radius: float,
    scene: Scene,
    world: int,
) -> Contact:
    """The earliest contact with the first ``surfaces`` surfaces on an arc.

    ``speed`` bounds the ball's, ``robot_speed`` that of paddle and body (m/s).
    """
    first = Contact()
    first.surface = NOTHING
    first.time = 2.0 * arc.duration
    sums = gaps + end_gaps
    still = wp.min(sums[TABLE], wp.min(sums[NET], sums[FLOOR]))
    moving = wp.min(sums[PADDLE], sums[BODY])
    if still >= speed * arc.duration and moving >= (speed + robot_speed) * arc.duration:
        return first  # all surfaces stay too far away
    for surface in range(surfaces):  # of a fixed number, Warp would write five copies
        relative = wp.float32(speed)
        if surface >= PADDLE:
            relative += robot_speed
        gap = gaps[surface]
        end_gap = end_gaps[surface]
        if may_touch(gap, end_gap, relative, arc.duration):
            contact = contact_with(surface, arc, gap, end_gap, radius, scene, world)
            if contact.surface != NOTHING and contact.time < first.time:
                first = contact
    return first
