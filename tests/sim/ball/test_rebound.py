"""Shapes and rebounds: against plain geometry, closed forms, and the balance of momentum in double precision."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import pace.sim  # noqa: F401  sets Warp up before the kernels below are defined
from pace.sim.ball.ball import BallParams
from pace.sim.ball.rebound import Material, box_distance, disc_distance, rebound, slip_velocity
from pace.studies import ball_reference as reference

RADIUS = 0.02
BOX_CENTRE = np.array([0.1, -0.2, 0.5])
BOX_HALF = np.array([0.4, 0.3, 0.05])
DISC_RADIUS, DISC_HALF = 0.078, 0.0075


@wp.kernel
def _box(points: wp.array[wp.vec3], centre: wp.vec3, half: wp.vec3, out: wp.array[wp.vec4]):
    i = wp.tid()
    distance, normal = box_distance(points[i], centre, half)
    out[i] = wp.vec4(distance, normal[0], normal[1], normal[2])


@wp.kernel
def _disc(points: wp.array[wp.vec3], axis: wp.vec3, radius: float, half: float, out: wp.array[wp.vec4]):
    i = wp.tid()
    distance, normal = disc_distance(points[i], axis, radius, half)
    out[i] = wp.vec4(distance, normal[0], normal[1], normal[2])


@wp.kernel
def _rebound(
    velocity: wp.array[wp.vec3],
    spin: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    surface: wp.array[wp.vec3],
    radius: float,
    material: Material,
    velocity_out: wp.array[wp.vec3],
    spin_out: wp.array[wp.vec3],
    slip_out: wp.array[wp.vec3],
):
    i = wp.tid()
    after, after_spin = rebound(velocity[i], spin[i], normal[i], surface[i], radius, material)
    velocity_out[i] = after
    spin_out[i] = after_spin
    slip_out[i] = slip_velocity(after - surface[i], after_spin, normal[i], radius)


def box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) and normal (N, 3) of the box."""
    out = wp.zeros(len(points), dtype=wp.vec4, device="cpu")
    inputs = [wp.array(points, dtype=wp.vec3, device="cpu"), wp.vec3(*BOX_CENTRE), wp.vec3(*BOX_HALF), out]
    wp.launch(_box, dim=len(points), inputs=inputs, device="cpu")
    return out.numpy()[:, 0], out.numpy()[:, 1:]


def disc(points: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) and normal (N, 3) of the disc at the origin."""
    out = wp.zeros(len(points), dtype=wp.vec4, device="cpu")
    inputs = [wp.array(points, dtype=wp.vec3, device="cpu"), wp.vec3(*axis), DISC_RADIUS, DISC_HALF, out]
    wp.launch(_disc, dim=len(points), inputs=inputs, device="cpu")
    return out.numpy()[:, 0], out.numpy()[:, 1:]


def strike(
    velocity: np.ndarray,
    spin: np.ndarray,
    normal: np.ndarray,
    surface: np.ndarray,
    restitution: float,
    friction: float,
    slope: float = 0.0,
    lowest: float = 0.0,
    tangential: float = 0.0,
    tangential_slope: float = 0.0,
    drilling_loss: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocity, spin and slip (N, 3) after the rebound."""
    material = Material()
    material.tangential, material.tangential_slope = tangential, tangential_slope
    material.drilling_loss = drilling_loss
    material.restitution, material.slope, material.friction, material.lowest = restitution, slope, friction, lowest
    given = [wp.array(a, dtype=wp.vec3, device="cpu") for a in (velocity, spin, normal, surface)]
    out = [wp.zeros(len(velocity), dtype=wp.vec3, device="cpu") for _ in range(3)]
    wp.launch(_rebound, dim=len(velocity), inputs=[*given, RADIUS, material, *out], device="cpu")
    after, after_spin, slip = (a.numpy() for a in out)
    return after, after_spin, slip


def random_strikes(count: int = 2000) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Velocity, spin, normal and surface velocity of approaching contacts."""
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    surface = rng.uniform(-5, 5, (count, 3))
    tangential = rng.uniform(-8, 8, (count, 3))
    tangential -= np.sum(tangential * normal, axis=1, keepdims=True) * normal
    relative = tangential - rng.uniform(0.1, 12, (count, 1)) * normal
    return surface + relative, rng.uniform(-300, 300, (count, 3)), normal, surface


def test_box_distance_is_that_of_the_nearest_point():
    points = BOX_CENTRE + np.random.default_rng(0).uniform(-0.8, 0.8, (400, 3))
    distance, normal = box(points)
    nearest = np.clip(points, BOX_CENTRE - BOX_HALF, BOX_CENTRE + BOX_HALF)
    outside = np.linalg.norm(points - nearest, axis=1)
    inside = np.min(BOX_HALF - np.abs(points - BOX_CENTRE), axis=1)
    expected = np.where(outside > 1e-12, outside, -inside)
    np.testing.assert_allclose(distance, expected, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-5)
    # Going back along the normal by the distance leads onto the surface.
    np.testing.assert_allclose(box(points - distance[:, None] * normal)[0], 0.0, atol=2e-6)


def test_disc_distance_is_that_of_the_nearest_point_of_faces_and_rim():
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    points = np.random.default_rng(1).uniform(-0.15, 0.15, (400, 3))
    distance, normal = disc(points, axis)
    height = points @ axis
    radial = points - height[:, None] * axis
    reach = np.linalg.norm(radial, axis=1)
    foot = np.minimum(reach, DISC_RADIUS)[:, None] * radial / reach[:, None]
    foot += np.clip(height, -DISC_HALF, DISC_HALF)[:, None] * axis
    outside = np.linalg.norm(points - foot, axis=1)
    inside = np.minimum(DISC_RADIUS - reach, DISC_HALF - np.abs(height))
    np.testing.assert_allclose(distance, np.where(outside > 1e-12, outside, -inside), atol=1e-6)
    np.testing.assert_allclose(disc(points - distance[:, None] * normal, axis)[0], 0.0, atol=2e-6)


def test_rebound_agrees_with_the_balance_of_momentum():
    velocity, spin, normal, surface = random_strikes()
    after, after_spin, _ = strike(velocity, spin, normal, surface, 0.85, 0.25)
    full = np.full(len(velocity), 1.0)
    expected, expected_spin = reference.rebound(
        velocity, spin, normal, surface, RADIUS * full, 0.85 * full, 0.25 * full
    )
    np.testing.assert_allclose(after, expected, atol=2e-5)
    np.testing.assert_allclose(after_spin, expected_spin, atol=2e-3)


@pytest.mark.parametrize("friction", [0.1, 0.25, 0.6])
def test_rebound_is_what_a_contact_that_takes_time_comes_to(friction: float):
    """A push like a half sine for 1 ms, Coulomb friction integrated through it: no closed form takes part."""
    velocity, spin, normal, surface = random_strikes()
    after, after_spin, _ = strike(velocity, spin, normal, surface, 0.85, friction)
    push = -1.85 * np.sum((velocity - surface) * normal, axis=1, keepdims=True)
    v, turning, steps = velocity.copy(), spin.copy(), 2000
    for step in range(steps):
        share = push * (np.cos(np.pi * step / steps) - np.cos(np.pi * (step + 1) / steps)) / 2
        v += share * normal
        at_contact = v - surface + np.cross(turning, -RADIUS * normal)
        slip = at_contact - np.sum(at_contact * normal, axis=1, keepdims=True) * normal
        speed = np.maximum(np.linalg.norm(slip, axis=1, keepdims=True), 1e-12)
        # Friction of this instant, but no more than takes half of the slip: it cannot turn it round.
        grip = -slip / speed * np.minimum(friction * share, 0.2 * speed)
        v += grip
        turning += np.cross(-RADIUS * normal, grip) / (2 / 3 * RADIUS**2)
    slides = np.linalg.norm(slip, axis=1) > 1e-2
    assert 100 < slides.sum() < len(velocity) - 100  # both branches take part
    np.testing.assert_allclose(after, v, atol=2e-2)
    np.testing.assert_allclose(after_spin, turning, atol=1.5)
    np.testing.assert_allclose(after[slides], v[slides], atol=2e-5)


def test_angular_momentum_about_the_contact_is_kept():
    """The impulse acts there, whatever it is; and along the normal nothing but restitution is left."""
    velocity, spin, normal, surface = random_strikes()
    after, after_spin, _ = strike(velocity, spin, normal, surface, 0.85, 0.25)
    change = RADIUS * np.cross(normal, after - velocity) + 2 / 3 * RADIUS**2 * (after_spin - spin)
    np.testing.assert_allclose(change, 0.0, atol=2e-6)
    normal_speed = np.sum((velocity - surface) * normal, axis=1)
    np.testing.assert_allclose(np.sum((after - surface) * normal, axis=1), -0.85 * normal_speed, atol=2e-5)


def test_sliding_branch_by_hand():
    # v_n = -2, v_x = 5, mu = 0.1, e = 0.9: friction takes 0.1 * 1.9 * 2 = 0.38 m/s, less than 2/5 of 5.
    after, spin, _ = strike(*_one([5.0, 0, -2.0], [0, 0, 0]), 0.9, 0.1)
    np.testing.assert_allclose(after[0], [4.62, 0.0, 1.8], atol=1e-6)
    # 1.5 / 0.02 * 0.38 = 28.5 rad/s of topspin about +y.
    np.testing.assert_allclose(spin[0], [0.0, 28.5, 0.0], atol=1e-4)


def test_rolling_branch_by_hand():
    # v_x = 1, mu = 0.5: sliding would take 1.9, so the contact stops after 2/5 and the ball rolls.
    after, spin, slip = strike(*_one([1.0, 0, -2.0], [0, 0, 0]), 0.9, 0.5)
    np.testing.assert_allclose(after[0], [0.6, 0.0, 1.8], atol=1e-6)
    np.testing.assert_allclose(spin[0], [0.0, 0.6 / RADIUS, 0.0], atol=1e-4)
    np.testing.assert_allclose(slip[0], 0.0, atol=1e-6)


def test_spin_becomes_speed_by_hand():
    # Backspin of 100 rad/s about -y slips forwards at the contact by 2 m/s and turns the ball back: -2/5 of 2.
    after, spin, _ = strike(*_one([0, 0, -3.0], [0, -100.0, 0]), 0.9, 0.5)
    np.testing.assert_allclose(after[0], [-0.8, 0.0, 2.7], atol=1e-6)
    np.testing.assert_allclose(spin[0], [0.0, -40.0, 0.0], atol=1e-4)


def _one(velocity: list[float], spin: list[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One contact with a resting floor."""
    return np.array([velocity]), np.array([spin]), np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3))


@pytest.mark.parametrize("tangential", [-0.2, 0.0, 0.5, 1.0])
@pytest.mark.parametrize(("restitution", "friction"), [(1.0, 0.0), (1.0, 0.25), (0.9, 1.0), (0.3, 0.1), (0.0, 0.5)])
def test_energy_in_the_frame_of_the_surface_never_grows(restitution: float, friction: float, tangential: float):
    velocity, spin, normal, surface = random_strikes()
    after, after_spin, _ = strike(velocity, spin, normal, surface, restitution, friction, tangential=tangential)
    before = energy(velocity, spin, surface)
    assert np.all(energy(after, after_spin, surface) <= before * (1 + 1e-5))
    if restitution == 1.0 and friction == 0.0:
        np.testing.assert_allclose(energy(after, after_spin, surface), before, rtol=1e-5)


def energy(velocity: np.ndarray, spin: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Twice the energy per unit of mass (N,), in the frame of the surface."""
    return np.sum((velocity - surface) ** 2, axis=1) + 2 / 3 * RADIUS**2 * np.sum(spin**2, axis=1)


def test_spin_about_the_normal_is_left_alone():
    velocity, spin, normal, surface = random_strikes()
    _, after_spin, _ = strike(velocity, spin, normal, surface, 0.9, 0.3)
    np.testing.assert_allclose(np.sum((after_spin - spin) * normal, axis=1), 0.0, atol=1e-3)


@pytest.mark.parametrize(("speed", "restitution"), [(1.0, 0.86), (5.0, 0.78), (30.0, 0.4)])
def test_restitution_falls_with_the_normal_speed_down_to_its_lowest(speed: float, restitution: float):
    after, _, _ = strike(*_one([0, 0, -speed], [0, 0, 0]), 0.88, 0.2, slope=0.02, lowest=0.4)
    assert after[0, 2] == pytest.approx(restitution * speed, rel=1e-5)


def test_nothing_happens_to_a_ball_that_leaves():
    velocity, spin, normal, surface = random_strikes()
    leaving = surface + np.abs(np.sum((velocity - surface) * normal, axis=1, keepdims=True)) * normal
    after, after_spin, _ = strike(leaving, spin, normal, surface, 0.9, 0.3)
    np.testing.assert_allclose(after, leaving, atol=1e-6)
    np.testing.assert_allclose(after_spin, spin, atol=1e-5)


# --- rubber -----------------------------------------------------------------------------------------------------------

GRIPS = 1e3  # friction that never lets the contact slide


def test_springing_rebound_agrees_with_the_balance_of_momentum():
    velocity, spin, normal, surface = random_strikes()
    after, after_spin, _ = strike(velocity, spin, normal, surface, 0.85, 0.6, tangential=0.8)
    one = np.ones(len(velocity))
    expected = reference.rebound(velocity, spin, normal, surface, RADIUS * one, 0.85 * one, 0.6 * one, 0.8 * one)
    np.testing.assert_allclose(after, expected[0], atol=3e-5)
    np.testing.assert_allclose(after_spin, expected[1], atol=3e-3)


@pytest.mark.parametrize("tangential", [-0.2, 0.0, 0.3, 0.82, 1.0])
def test_a_contact_that_grips_reverses_its_slip(tangential: float):
    velocity, spin, normal, surface = random_strikes()
    before = velocity - surface + np.cross(spin, -RADIUS * normal)
    before -= np.sum(before * normal, axis=1, keepdims=True) * normal
    _, _, slip = strike(velocity, spin, normal, surface, 0.85, GRIPS, tangential=tangential)
    np.testing.assert_allclose(slip, -tangential * before, atol=2e-5)


def test_springing_share_by_hand():
    # u = 5 m/s, e_t = 0.9 - 0.02 * 5 = 0.8: the centre loses 2/5 * 1.8 = 0.72 of 5, the spin gains 1.5 / r * 3.6.
    after, spin, slip = strike(*_one([5.0, 0, -4.0], [0, 0, 0]), 0.5, GRIPS, tangential=0.9, tangential_slope=0.02)
    np.testing.assert_allclose(after[0], [1.4, 0.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(spin[0], [0.0, 270.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(slip[0], [-4.0, 0.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("damping", [0.0, 0.05, 0.3])
def test_springing_rebound_is_what_a_tangential_spring_comes_to(damping: float):
    """The contact point hangs on a damped spring for half of its period, integrated: no closed form takes part.

    The slip sees 2/5 of the mass, so the spring's rate is that of an oscillator of 1 ms contact; its damping alone says
    how much comes back: exp(-pi zeta / sqrt(1 - zeta^2)).
    """
    velocity, spin, normal, surface = random_strikes(300)
    contact_time, steps = 1.0e-3, 20_000
    rate = np.pi / contact_time / np.sqrt(1.0 - damping**2)
    stiffness, drag = 0.4 * rate**2, 0.4 * 2.0 * damping * rate  # per unit of the ball's mass
    v, turning, stretch, dt = velocity.copy(), spin.copy(), np.zeros_like(velocity), contact_time / steps
    for _ in range(steps):
        at_contact = v - surface + np.cross(turning, -RADIUS * normal)
        slip = at_contact - np.sum(at_contact * normal, axis=1, keepdims=True) * normal
        stretch += dt * slip
        pull = -dt * (stiffness * stretch + drag * slip)
        v += pull
        turning += np.cross(-RADIUS * normal, pull) / (2 / 3 * RADIUS**2)
    comes_back = np.exp(-np.pi * damping / np.sqrt(1.0 - damping**2))
    v -= 1.85 * np.sum((velocity - surface) * normal, axis=1, keepdims=True) * normal
    after, after_spin, _ = strike(velocity, spin, normal, surface, 0.85, GRIPS, tangential=comes_back)
    np.testing.assert_allclose(after, v, atol=5e-3)
    np.testing.assert_allclose(after_spin, turning, atol=0.4)


@pytest.mark.parametrize("tangential", [0.0, 0.8])
@pytest.mark.parametrize("drilling_loss", [0.0, 0.195])
def test_rubber_keeps_angular_momentum_but_for_the_drilling_spin(tangential: float, drilling_loss: float):
    velocity, spin, normal, surface = random_strikes()
    given = {"tangential": tangential, "drilling_loss": drilling_loss}
    after, after_spin, _ = strike(velocity, spin, normal, surface, 0.85, 0.5, **given)
    change = RADIUS * np.cross(normal, after - velocity) + 2 / 3 * RADIUS**2 * (after_spin - spin)
    drilling = np.sum(spin * normal, axis=1)
    expected = -2 / 3 * RADIUS**2 * drilling_loss * drilling[:, None] * normal
    np.testing.assert_allclose(change, expected, atol=2e-6)
    np.testing.assert_allclose(np.sum(after_spin * normal, axis=1), (1 - drilling_loss) * drilling, atol=1e-3)


@pytest.mark.parametrize("topspin", [50.0, 100.0, 150.0])
def test_topspin_comes_back_from_a_still_blade_reversed_or_nearly_still(topspin: float):
    """Measured rubber: e_t = 0.819 - 0.010 u leaves 1 - 3/5 (1 + e_t) of the spin, about -0.08."""
    ball = BallParams.preset("rubber")
    given = {
        "tangential": float(ball.paddle_tangential_restitution),
        "tangential_slope": float(ball.paddle_tangential_restitution_slope),
    }
    _, after, _ = strike(*_one([0, 0, -5.0], [0, topspin, 0]), 0.778, float(ball.paddle_friction), **given)
    springing = 0.819 - 0.010 * RADIUS * topspin
    assert after[0, 1] == pytest.approx((1 - 0.6 * (1 + springing)) * topspin, rel=1e-3)
    assert -0.15 * topspin < after[0, 1] < 0.0


def test_rubber_does_not_depend_on_the_frame():
    velocity, spin, normal, surface = random_strikes()
    given = {"tangential": 0.819, "tangential_slope": 0.01, "drilling_loss": 0.195}
    drift = np.array([3.0, -7.0, 2.0])
    still, still_spin, _ = strike(velocity, spin, normal, surface, 0.85, 1.0, **given)
    moved, moved_spin, _ = strike(velocity + drift, spin, normal, surface + drift, 0.85, 1.0, **given)
    np.testing.assert_allclose(moved - drift, still, atol=3e-5)
    np.testing.assert_allclose(moved_spin, still_spin, atol=3e-3)
    turn = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])  # a proper rotation
    v, w, n, s = (a @ turn.T for a in (velocity, spin, normal, surface))
    turned, turned_spin, _ = strike(v, w, n, s, 0.85, 1.0, **given)
    np.testing.assert_allclose(turned, still @ turn.T, atol=3e-5)
    np.testing.assert_allclose(turned_spin, still_spin @ turn.T, atol=3e-3)


def test_rubber_takes_at_most_what_friction_gives():
    # u = 10 m/s, mu = 0.1: friction takes 0.1 * 1.5 * 2 = 0.3 m/s, whatever would spring back.
    after, _, _ = strike(*_one([10.0, 0, -2.0], [0, 0, 0]), 0.5, 0.1, tangential=0.8)
    np.testing.assert_allclose(after[0], [9.7, 0.0, 1.0], atol=1e-6)
