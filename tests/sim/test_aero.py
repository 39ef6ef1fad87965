"""Flight in air: closed forms, order of convergence, and drag found back from flights as the paper found it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import warp as wp
from scipy.optimize import least_squares

import pace.sim  # noqa: F401  sets Warp up before the kernel below is defined
from pace.sim.aero import GRAVITY, air_factors, fly
from pace.sim.ball import BallParams, BallSim, ball_preset

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


def recorded_flights(count: int, frames: int, noise: float) -> np.ndarray:
    """Ball positions (frames, count, 3) m of flights before the bounce, 50 a second, as a motion capture sees them."""
    rng = np.random.default_rng(4)
    preset = ball_preset("paper")
    sim = BallSim(count, "cpu", BallParams.from_config(preset), preset.table, 0.02, 1, 0.02)
    path = torch.zeros(count, 2, 12)
    path[:, :, 2], path[:, :, 5] = 9.0, 1.0
    sim.position.copy_(torch.tensor([1.35, 0.0, 1.03]).expand(count, 3))
    sim.velocity.copy_(torch.tensor(rng.uniform([-6.5, -0.8, 1.5], [-5.0, 0.4, 2.0], (count, 3))))
    frames_seen = [sim.position.numpy().copy()]
    for _ in range(frames - 1):
        sim.fly(path)
        frames_seen.append(sim.position.numpy().copy())
    return np.stack(frames_seen) + rng.normal(0.0, noise, (frames, count, 3))


def model_flights(k: float, start: np.ndarray, frames: int) -> np.ndarray:
    """Positions (frames, ...) of flights from ``start`` (2, ..., 3): position and velocity, by fine midpoint steps."""
    position, velocity = start.copy()
    gravity = np.array([0.0, 0.0, -GRAVITY])
    seen = [position.copy()]
    for _ in range(frames - 1):
        for _ in range(4):
            a = gravity - k * np.linalg.norm(velocity, axis=-1, keepdims=True) * velocity
            middle = velocity + 0.0025 * a
            a = gravity - k * np.linalg.norm(middle, axis=-1, keepdims=True) * middle
            position, velocity = position + 0.005 * middle, velocity + 0.005 * a
        seen.append(position.copy())
    return np.stack(seen)


def fitted_drag(flights: np.ndarray) -> float:
    """k (1/m) of all flights, with start and velocity of each free: least squares on the positions."""
    frames, count, _ = flights.shape
    launch = np.stack([flights[0], (flights[1] - flights[0]) / 0.02])

    def residual(parameters: np.ndarray) -> np.ndarray:
        start = parameters[1:].reshape(2, count, 3)
        return (model_flights(parameters[0], start, frames) - flights).ravel()

    def jacobian(parameters: np.ndarray) -> np.ndarray:
        """Flights are independent, so one perturbed run serves the same parameter of all of them."""
        base = residual(parameters)
        out = np.zeros((base.size, parameters.size))
        out[:, 0] = (residual(parameters + 1e-5 * np.eye(1, parameters.size)[0]) - base) / 1e-5
        rows = np.arange(base.size).reshape(frames, count, 3)
        for part in range(2):
            for axis in range(3):
                step = np.zeros((2, count, 3))
                step[part, :, axis] = 1e-5
                change = residual(parameters + np.concatenate([[0.0], step.ravel()])) - base
                for flight in range(count):
                    column = 1 + (part * count + flight) * 3 + axis
                    out[rows[:, flight].ravel(), column] = change[rows[:, flight].ravel()] / 1e-5
        return out

    start = np.concatenate([[0.05], launch.ravel()])
    return float(least_squares(residual, start, jac=jacobian, method="lm").x[0])  # type: ignore[arg-type]


@pytest.mark.parametrize(("noise", "tolerance"), [(0.0, 5e-4), (0.001, 0.02)])
def test_drag_is_found_back_from_22_flights(noise: float, tolerance: float):
    assert fitted_drag(recorded_flights(22, 20, noise)) == pytest.approx(PAPER_DRAG, rel=tolerance)
