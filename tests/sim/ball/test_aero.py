"""Flight in air: closed forms, order of convergence, and drag found back from flights as the paper found it."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import pace.sim  # noqa: F401  sets Warp up before the kernel below is defined
from pace.sim.ball.aero import GRAVITY, air_factors, fly
from pace.sim.ball.ball import BallParams
from pace.studies.ball_trials import fitted_drag, recorded_flights, true_drag

MASS, RADIUS, DENSITY = 0.0027, 0.02, 1.225
PAPER_DRAG = 0.0991  # 1/m, facts of the paper's simulation


@wp.kernel
def _fly(
    velocity: wp.array[wp.vec3],
    spin: wp.array[wp.vec3],
    drag: float,
    magnus: float,
    dt: float,
    steps: int,
    position_out: wp.array[wp.vec3],
    velocity_out: wp.array[wp.vec3],
    factors: wp.array[wp.vec2],
):
    i = wp.tid()
    air = air_factors(DENSITY, drag, magnus, RADIUS, MASS)
    p = wp.vec3(0.0, 0.0, 0.0)
    v = velocity[i]
    for _ in range(steps):
        p, v = fly(p, v, spin[i], air, dt)
    position_out[i] = p
    velocity_out[i] = v
    factors[i] = wp.vec2(air.drag, air.magnus)


def flown(
    velocity: list[float], spin: list[float], drag: float, magnus: float, dt: float, steps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Way (3,), velocity (3,) and the factors (drag 1/m, magnus) of one flight from the origin."""
    given = [wp.array([a], dtype=wp.vec3, device="cpu") for a in (velocity, spin)]
    out = [wp.zeros(1, dtype=t, device="cpu") for t in (wp.vec3, wp.vec3, wp.vec2)]
    wp.launch(_fly, dim=1, inputs=[*given, drag, magnus, dt, steps, *out], device="cpu")
    way, after, factors = (a.numpy()[0] for a in out)
    return way, after, factors


def test_factors_are_force_over_mass():
    _, _, (drag, magnus) = flown([1, 0, 0], [0, 0, 0], 0.47, 0.5, 0.01, 1)
    area = np.pi * RADIUS**2
    assert drag == pytest.approx(0.5 * DENSITY * 0.47 * area / MASS, rel=1e-6)
    assert magnus == pytest.approx(0.5 * DENSITY * area * RADIUS * 0.5 / MASS, rel=1e-6)


@pytest.mark.parametrize(("preset", "expected"), [("paper", 0.0991), ("standard", 0.134), ("venue", 0.1261)])
def test_presets_have_the_published_drag(preset: str, expected: float):
    ball = BallParams.preset(preset)
    area = np.pi * float(ball.radius) ** 2
    k = 0.5 * float(ball.air_density) * float(ball.drag_coefficient) * area / float(ball.mass)
    assert k == pytest.approx(expected, rel=2e-3)


def test_without_air_the_way_is_a_parabola():
    way, after, _ = flown([3.0, -2.0, 4.0], [100, 50, -20], 0.0, 0.0, 0.02, 50)
    np.testing.assert_allclose(way, [3.0, -2.0, 4.0 - GRAVITY / 2], atol=2e-5)
    np.testing.assert_allclose(after, [3.0, -2.0, 4.0 - GRAVITY], atol=2e-5)


def test_a_ball_that_falls_from_rest_follows_tanh():
    way, after, (k, _) = flown([0, 0, 0], [0, 0, 0], 0.5, 0.0, 0.02, 50)
    terminal = np.sqrt(GRAVITY / k)
    assert after[2] == pytest.approx(-terminal * np.tanh(GRAVITY / terminal), rel=1e-5)
    assert way[2] == pytest.approx(-np.log(np.cosh(GRAVITY / terminal)) / k, rel=1e-5)


def test_magnus_force_bends_topspin_down_and_does_no_work():
    # Towards +x with topspin about +y: omega x v points down.
    _, after, (_, magnus) = flown([10.0, 0, 0], [0, 100.0, 0], 0.0, 1.0, 1e-4, 1)
    assert after[2] == pytest.approx(-(GRAVITY + magnus * 1000.0) * 1e-4, rel=1e-4)
    way, after, _ = flown([10.0, 2.0, 3.0], [50.0, 100.0, -80.0], 0.0, 1.0, 0.01, 100)
    energy = 0.5 * np.sum(after.astype(float) ** 2) + GRAVITY * way[2]
    assert energy == pytest.approx(0.5 * (100 + 4 + 9), rel=1e-5)


def test_runge_kutta_is_of_fourth_order():
    # Coarse steps in a thick medium, so that the error stands out of float32's round-off.
    ends = [flown([20.0, 0, 5.0], [0, 300.0, 0], 2.0, 1.0, 0.2 / n, n)[0] for n in (4, 8, 256)]
    coarse, fine = np.linalg.norm(ends[0] - ends[2]), np.linalg.norm(ends[1] - ends[2])
    assert 10.0 < coarse / fine < 40.0


@pytest.mark.parametrize(("noise", "tolerance"), [(0.0, 5e-4), (0.001, 0.02)])
def test_drag_is_found_back_from_22_flights(noise: float, tolerance: float):
    assert true_drag("paper") == pytest.approx(PAPER_DRAG, rel=2e-3)
    assert fitted_drag(recorded_flights(22, 20, noise)) == pytest.approx(true_drag("paper"), rel=tolerance)
