"""Flight in air: closed forms, order of convergence, and drag found back from flights as the paper found it."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import pace.sim  # noqa: F401  sets Warp up before the kernel below is defined
from pace.sim.ball.aero import GRAVITY, AirTables, air_factors, fly, measured_drag, measured_lift
from pace.sim.ball.air_tables import air_tables, air_tensors
from pace.sim.ball.ball import BallParams, ball_preset
from pace.studies import ball_reference as reference
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
    air = air_factors(DENSITY, drag, magnus, 0.0, 0.0, RADIUS, MASS)
    p = wp.vec3(0.0, 0.0, 0.0)
    v = velocity[i]
    for _ in range(steps):
        p, v = fly(p, v, spin[i], air, AirTables(), dt)
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


@pytest.mark.parametrize(("preset", "expected"), [("paper", 0.0991), ("venue", 0.1261)])
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


# --- measured coefficients --------------------------------------------------------------------------------------------


@wp.kernel
def _look_up(
    tables: AirTables,
    speed: wp.array[wp.float32],
    turning: wp.array[wp.float32],
    radius: float,
    out: wp.array[wp.vec2],
):
    i = wp.tid()
    drag = measured_drag(tables.drag, speed[i], radius * turning[i] / speed[i])
    out[i] = wp.vec2(drag, measured_lift(tables.lift, speed[i], turning[i]))


def coefficients(speed: np.ndarray, turning: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """C_d and C_M (N,) at speeds m/s and spins rad/s (N,)."""
    air = ball_preset("rubber").air
    assert air is not None
    kept = air_tensors(air, "cpu")
    given = [wp.array(a, dtype=wp.float32, device="cpu") for a in (speed, turning)]
    out = wp.zeros(len(speed), dtype=wp.vec2, device="cpu")
    wp.launch(_look_up, dim=len(speed), inputs=[air_tables(kept), *given, RADIUS, out], device="cpu")
    return out.numpy()[:, 0], out.numpy()[:, 1]


def at_ratio(speed: float, ratio: float) -> tuple[float, float]:
    """C_d and C_M at a speed and a spin ratio."""
    drag, lift = coefficients(np.array([speed]), np.array([ratio * speed / RADIUS]))
    return float(drag[0]), float(lift[0])


@pytest.mark.parametrize(
    ("speed", "ratio", "drag"),
    [
        *((2.5, 1.0, 0.55), (7.5, 0.4, 0.49), (7.5, 0.75, 0.55), (7.5, 2.0, 0.53), (12.5, 0.95, 0.41)),
        *((17.5, 0.84, 0.37), (1.0, 0.0, 0.55), (5.0, 0.0, 0.52), (10.0, 0.2, 0.48), (7.5, 5.0, 0.53)),
        *((20.0, 0.0, 0.47), (7.5, 0.575, 0.52)),
    ],
)
def test_measured_drag_at_the_tables_points_and_between_and_beyond_them(speed: float, ratio: float, drag: float):
    assert at_ratio(speed, ratio)[0] == pytest.approx(drag, abs=1e-5)


def test_measured_drag_is_extrapolated_above_the_last_row():
    # S = 0.84: 0.37 at 17.5 m/s, and 0.53 - 0.12 (0.84 - 0.62) / 0.33 = 0.45 at 12.5 m/s.
    assert at_ratio(20.0, 0.84)[0] == pytest.approx(0.37 - 0.5 * (0.45 - 0.37), abs=1e-5)
    assert at_ratio(100.0, 0.84)[0] == 0.0


@pytest.mark.parametrize(
    ("speed", "turning", "lift"),
    [
        *((7.5, 100.0, 0.29), (7.5, 400.0, 0.0947), (10.5, 100.0, 0.3092), (9.0, 100.0, 0.2996)),
        *((1.0, 100.0, 0.08), (25.0, 500.0, 0.147), (2.0, 900.0, 0.0)),
    ],
)
def test_measured_lift_at_points_worked_out_by_hand(speed: float, turning: float, lift: float):
    assert coefficients(np.array([speed]), np.array([turning]))[1][0] == pytest.approx(lift, abs=1e-5)


def test_coefficients_agree_with_the_references_own():
    rng = np.random.default_rng(7)
    speed, turning = rng.uniform(0.5, 30.0, 3000), rng.uniform(0.0, 1000.0, 3000)
    drag, lift = coefficients(speed, turning)
    np.testing.assert_allclose(drag, reference.measured_drag(speed, RADIUS * turning / speed), atol=2e-5)
    np.testing.assert_allclose(lift, reference.measured_lift(speed, turning), atol=2e-5)


@pytest.mark.parametrize(("speed", "ratio", "measured"), [(14.0, 0.95, 0.41), (17.7, 0.88, 0.38)])
def test_measured_drag_agrees_with_open_match_data(speed: float, ratio: float, measured: float):
    """Fitted to 3,629 arcs of SonyResearch/ace_public, which the tables were not made from."""
    assert at_ratio(speed, ratio)[0] == pytest.approx(measured, abs=0.02)


def test_measured_lift_is_flat_over_the_spins_of_play():
    """C_L = 8/3 C_M S stays near 0.2 to 0.3 for S 0.4 to 1 at 7.5 to 17 m/s, where a slope of 0.87 S grows to 0.87."""
    speed, ratio = (a.ravel() for a in np.meshgrid(np.linspace(7.5, 17.0, 20), np.linspace(0.4, 1.0, 20)))
    lift = 8 / 3 * ratio * coefficients(speed, ratio * speed / RADIUS)[1]
    assert 0.14 < lift.min() < lift.max() < 0.32
    assert np.median(lift) == pytest.approx(0.24, abs=0.03)


@pytest.mark.parametrize(("preset", "share"), [("paper", 0.0), ("venue", 0.0), ("standard", 1.0), ("rubber", 1.0)])
def test_presets_take_constant_or_measured_coefficients(preset: str, share: float):
    ball = BallParams.preset(preset)
    assert ball.table_drag == ball.table_lift == share
    assert (float(ball.drag_coefficient) == 0.0) == (share == 1.0)
