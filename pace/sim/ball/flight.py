"""One sub-step of a ball among table, net, floor, a moving paddle and a moving body, as Warp functions.

The ball flies an arc; every surface whose gap closes within it is located by bisection on the arc's cubic Hermite
curve, the ball is flown again to the first of these contacts, and the impulse acts there. So the result depends neither
on the step nor on where in it the contact falls. A contact that goes on (rolling, resting, or squeezed) is settled at
the sub-step's end: no restitution, and the ball stands on the surface.
"""

import warp as wp

from pace.sim.ball.aero import GRAVITY, fly
from pace.sim.ball.arc import Arc
from pace.sim.ball.contact import Contact, first_contact
from pace.sim.ball.gaps import gap_to, gaps_to, surface_velocity
from pace.sim.ball.rebound import rebound
from pace.sim.ball.scene import BODY, FLOOR, NET, NOTHING, PADDLE, TABLE, Body, Gaps, Scene, material_of
from pace.sim.ball.state import BallArrays

#: m, longest way of the ball against a near surface in one sub-step; less than the ball's radius, so none is jumped.
MAX_TRAVEL = 0.015
#: s, shortest sub-step: 150 m/s still stays within MAX_TRAVEL.
MIN_SUBSTEP = 1.0e-4
#: Contacts that are located within one control step; later ones are settled at the ends of sub-steps.
MAX_LOCATED = 16


@wp.struct
class Flight:
    """A ball on its way: state, time flown, gap to each surface (m) and how many contacts were located."""

    position: wp.vec3
    velocity: wp.vec3
    spin: wp.vec3
    clock: wp.float32
    gaps: Gaps
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
def flight_of(ball: BallArrays, world: int) -> Flight:
    """The flight that begins with the ball of a world; its gaps are still to be found."""
    flight = Flight()
    flight.position = ball.position[world]
    flight.velocity = ball.velocity[world]
    flight.spin = ball.spin[world]
    return flight


@wp.func
def substep_length(gaps: Gaps, speed: float, robot_speed: float, remaining: float, longest: float) -> float:
    """Length (s) of the next sub-step: at most ``longest``, and no further than the nearest surface or MAX_TRAVEL."""
    still = wp.min(gaps[TABLE], wp.min(gaps[NET], gaps[FLOOR]))
    step = wp.min(longest, wp.max(still, MAX_TRAVEL) / speed)
    step = wp.min(step, wp.max(wp.min(gaps[PADDLE], gaps[BODY]), MAX_TRAVEL) / (speed + robot_speed))
    return remaining / wp.ceil(remaining / wp.max(step, MIN_SUBSTEP))


@wp.func
def settle(flight: Flight, contact: Contact, surfaces: int, body: Body, scene: Scene, world: int):
    """The flight after the impulse of ``contact``, at which ``flight`` has arrived; normal and surface velocity there.

    A lasting contact gives nothing back, along the normal or the surface, and the ball stands on the surface.
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
        material.tangential = wp.min(material.tangential, 0.0)  # a ball that goes on rolling does not spring
        material.tangential_slope = 0.0
        material.drilling_loss = 0.0  # of an impact, not of each sub-step
        after.position = flight.position - wp.min(gap, 0.0) * normal
        after.located = flight.located
    after_velocity, after_spin = rebound(flight.velocity, flight.spin, normal, velocity, body.radius, material)
    after.velocity = after_velocity
    after.spin = after_spin
    after.clock = flight.clock
    after.gaps = gaps_to(surfaces, after.position, after.clock, body.radius, scene, world)
    return after, normal, velocity


@wp.func
def free_arc(flight: Flight, body: Body, scene: Scene, duration: float) -> Arc:
    """The next ``duration`` s of a flight that meets nothing."""
    end, end_velocity = fly(flight.position, flight.velocity, flight.spin, body.air, scene.air, duration)
    arc = Arc()
    arc.clock = flight.clock
    arc.duration = duration
    arc.start = flight.position
    arc.end = end
    arc.start_velocity = flight.velocity
    arc.end_velocity = end_velocity
    return arc


@wp.func
def fly_leg(
    flight: Flight,
    surfaces: int,
    robot_speed: float,
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
    arc = free_arc(flight, body, scene, substep_length(flight.gaps, speed, robot_speed, remaining, longest))
    end_gaps = gaps_to(surfaces, arc.end, arc.clock + arc.duration, body.radius, scene, world)
    contact = first_contact(arc, flight.gaps, end_gaps, surfaces, speed, robot_speed, body.radius, scene, world)
    leg = Leg()
    leg.surface = contact.surface
    if contact.surface != NOTHING:
        contact.lasting = contact.lasting or flight.located >= MAX_LOCATED
        leg.begins = not contact.lasting
        if leg.begins:
            arc = free_arc(flight, body, scene, contact.time)
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
