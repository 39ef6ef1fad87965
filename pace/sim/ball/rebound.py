"""Shapes that a ball can hit and its rebound from them, as Warp functions.

Shapes give the signed distance of a point and the outward unit normal there, so edges and rims are rounded by the
ball's radius. The rebound is an impulse on a hollow sphere (inertia 2/3 m r^2). Along the normal the approach is
reversed with the restitution e. Along the surface the slip u of the contact point is reversed with the tangential
restitution e_t (0: it stops, and the ball rolls; rubber springs back: about 0.8), unless Coulomb friction is not enough
(sliding): the centre loses the share min(2/5 (1 + e_t), mu (1 + e) |v_n| / |u|) of u, and the spin changes by the same
impulse. Sources: Nakashima et al. 2010 (rigid surface); Conti et al. 2026, arXiv 2606.28805, table IV (rubber).
"""

import warp as wp

#: Share of the slip velocity that the centre loses when the contact stops slipping: 1 / (1 + m r^2 / I), I = 2/3 m r^2.
ROLLING_SHARE = 0.4


@wp.struct
class Material:
    """Contact of a ball with one surface.

    Restitution is ``restitution - slope |v_n|``, never below ``lowest``; tangential restitution is
    ``tangential - tangential_slope |u|``, never below -1 (no friction at all), u the slip of the contact point.
    """

    restitution: wp.float32
    slope: wp.float32  # s/m
    friction: wp.float32
    lowest: wp.float32
    tangential: wp.float32
    tangential_slope: wp.float32  # s/m
    drilling_loss: wp.float32  # share of the spin about the normal that a contact takes


@wp.func
def box_distance(point: wp.vec3, centre: wp.vec3, half: wp.vec3):
    """Signed distance (m) and outward normal of ``point`` to a box along the world's axes with half sizes ``half``."""
    offset = point - centre
    side = wp.vec3(wp.sign(offset[0]), wp.sign(offset[1]), wp.sign(offset[2]))
    beyond = wp.cw_mul(offset, side) - half
    outside = wp.vec3(wp.max(beyond[0], 0.0), wp.max(beyond[1], 0.0), wp.max(beyond[2], 0.0))
    distance = wp.length(outside)
    normal = wp.cw_mul(outside, side) / wp.max(distance, 1.0e-9)
    if distance == 0.0:
        if beyond[2] >= beyond[0] and beyond[2] >= beyond[1]:
            distance = beyond[2]
            normal = wp.vec3(0.0, 0.0, side[2])
        elif beyond[0] >= beyond[1]:
            distance = beyond[0]
            normal = wp.vec3(side[0], 0.0, 0.0)
        else:
            distance = beyond[1]
            normal = wp.vec3(0.0, side[1], 0.0)
    return distance, normal


@wp.func
def disc_distance(offset: wp.vec3, axis: wp.vec3, radius: float, half_thickness: float):
    """Signed distance (m) and outward normal at ``offset`` from the centre of a disc: two faces, a rim."""
    height = wp.dot(offset, axis)
    radial = offset - height * axis
    reach = wp.length(radial)
    face = axis * wp.sign(height)
    rim = radial / wp.max(reach, 1.0e-9)
    above = wp.abs(height) - half_thickness
    beyond = reach - radius
    if beyond <= 0.0 or above <= 0.0:
        if above >= beyond:
            return above, face
        return beyond, rim
    distance = wp.sqrt(above * above + beyond * beyond)
    return distance, (above * face + beyond * rim) / distance


@wp.func
def slip_velocity(velocity: wp.vec3, spin: wp.vec3, normal: wp.vec3, radius: float) -> wp.vec3:
    """Tangential velocity (m/s) of the ball's surface at the contact; ``velocity`` is relative to the surface there."""
    at_contact = velocity - radius * wp.cross(spin, normal)
    return at_contact - wp.dot(at_contact, normal) * normal


@wp.func
def rebound(velocity: wp.vec3, spin: wp.vec3, normal: wp.vec3, surface: wp.vec3, radius: float, material: Material):
    """Velocity and spin of a ball after an impulse; unchanged if it does not approach the surface.

    ``normal`` is a unit vector from the surface to the ball; ``surface`` is the velocity (m/s) of the surface's point
    at the contact. The surface is taken as infinitely heavy.
    """
    relative = velocity - surface
    approach = -wp.dot(relative, normal)
    if approach <= 0.0:
        return velocity, spin
    restitution = wp.max(material.restitution - material.slope * approach, material.lowest)
    push = (1.0 + restitution) * approach
    slip = slip_velocity(relative, spin, normal, radius)
    speed = wp.length(slip)
    springing = wp.max(material.tangential - material.tangential_slope * speed, -1.0)
    share = wp.min(ROLLING_SHARE * (1.0 + springing), material.friction * push / wp.max(speed, 1.0e-9))
    friction = -share * slip
    drilling = material.drilling_loss * wp.dot(spin, normal) * normal
    return velocity + push * normal + friction, spin - (1.5 / radius) * wp.cross(normal, friction) - drilling
