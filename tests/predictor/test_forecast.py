"""The forecast: against an ODE solver over 1,000 serves, and against the simulated flight that it stands for."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
from torch import Tensor

from pace.predictor import Forecast, forecast_flight
from pace.sim.ball.ball import BallParams, BallSim, ball_preset
from pace.studies import ball_reference as reference
from pace.studies.ball_trials import far_path, first_contacts, random_returns

DT = 0.02
TABLE = ball_preset("rubber").table
TOP = TABLE.height
VACUUM = BallParams(0.0027, 0.02, 0.0, 0.0, 0.0, 0.9, 0.0, 0.0, 0.8, 0.0, 0.3)
G = 9.81


def rows(*values: list[float]) -> Tensor:
    """(N, 3) float32."""
    return torch.tensor(values, dtype=torch.float32)


def test_1000_serves_agree_with_the_ode_solution():
    serves = reference.random_serves(1000)
    given = {f.name: torch.tensor(getattr(serves.ball, f.name)) for f in fields(serves.ball)}
    params = BallParams(**given, paddle_restitution=0.8, paddle_restitution_slope=0.0, paddle_friction=0.3)
    start = (torch.tensor(a, dtype=torch.float32) for a in (serves.position, serves.velocity, serves.spin))
    forecast, flight = forecast_flight(*start, params=params, table=TABLE), serves.flight
    # Asked for: 1 mm and 0.5 ms. Measured: 3 um and 1 us.
    np.testing.assert_allclose(forecast.bounce_time, flight.bounce_time, atol=1e-5)
    np.testing.assert_allclose(forecast.bounce, flight.bounce, atol=2e-5)
    np.testing.assert_allclose(forecast.bounce_velocity, flight.bounce_velocity, atol=2e-4)
    np.testing.assert_allclose(forecast.apex_time, flight.apex_time, atol=1e-5)
    np.testing.assert_allclose(forecast.apex, flight.apex, atol=2e-5)
    assert torch.equal(forecast.landing, forecast.bounce)
    assert bool(forecast.landing_own.all())
    assert not forecast.landing_opponent.any()
    assert bool(forecast.net_height.isnan().all())


def test_closed_form_without_air():
    # Falls on the frictionless table, bounces with e = 0.9, and passes x = -1.6 after its apex.
    forecast = forecast_flight(rows([0.3, 0.1, TOP + 0.02 + 0.3]), rows([-2.0, 0.2, 0.0]), params=VACUUM)
    fall = np.sqrt(2 * 0.3 / G)
    rise = 0.9 * fall
    apex = np.array([0.3 - 2.0 * (fall + rise), 0.1 + 0.2 * (fall + rise), TOP + 0.02 + 0.81 * 0.3])
    assert float(forecast.bounce_time) == pytest.approx(fall, abs=1e-6)
    np.testing.assert_allclose(forecast.bounce_velocity[0], [-2.0, 0.2, 0.9 * G * fall], atol=1e-5)
    np.testing.assert_allclose(forecast.apex[0], apex, atol=1e-5)
    assert float(forecast.apex_time) == pytest.approx(fall + rise, abs=2e-6)


@pytest.mark.parametrize("crossing", [-0.2, -1.05])
def test_intercept_is_the_later_of_apex_and_crossing(crossing: float):
    position, velocity = rows([0.3, 0.0, TOP + 0.32]), rows([-2.0, 0.0, 0.0])
    forecast = forecast_flight(position, velocity, params=VACUUM, intercept_x=crossing)
    fall = np.sqrt(2 * 0.3 / G)
    apex_time = 1.9 * fall
    time = max(apex_time, (0.3 - crossing) / 2.0)
    since = time - apex_time
    assert float(forecast.intercept_time) == pytest.approx(time, abs=2e-6)
    np.testing.assert_allclose(
        forecast.intercept[0], [0.3 - 2.0 * time, 0.0, TOP + 0.02 + 0.243 - G / 2 * since**2], atol=1e-5
    )
    np.testing.assert_allclose(forecast.intercept_velocity[0], [-2.0, 0.0, -G * since], atol=2e-5)


def test_landing_and_net_height_of_a_return():
    # From (-1.5, 0, 1.0) at 5 m/s forwards and 2 m/s up, without air.
    forecast = forecast_flight(rows([-1.5, 0.2, 1.0]), rows([5.0, 0.0, 2.0]), params=VACUUM)
    drop = 1.0 - TOP - 0.02
    time = (2.0 + np.sqrt(4.0 + 2 * G * drop)) / G
    assert float(forecast.landing_time) == pytest.approx(time, abs=2e-6)
    np.testing.assert_allclose(forecast.landing[0], [-1.5 + 5.0 * time, 0.2, TOP + 0.02], atol=1e-5)
    assert bool(forecast.landing_opponent)
    assert not bool(forecast.landing_own)
    assert float(forecast.net_height) == pytest.approx(1.0 + 2.0 * 0.3 - G / 2 * 0.09, abs=1e-5)
    for name in ("bounce_time", "apex_time", "intercept_time", "bounce", "apex", "intercept"):
        assert bool(getattr(forecast, name).isnan().all()), name


def test_a_touch_of_the_net_counts_before_the_landing_alone():
    # Into the net; over it; and, after a bounce in front of it, into it.
    position = rows([0.5, 0.0, 0.85], [1.35, 0.0, 1.03], [0.6, 0.0, 0.9])
    forecast = forecast_flight(position, rows([-5.0, 0.0, 0.0], [-5.8, 0.0, 1.75], [-2.0, 0.0, 0.0]), params=VACUUM)
    assert forecast.net_touched.tolist() == [True, False, False]
    assert forecast.landing_own.tolist() == [False, True, False]


def test_a_ball_that_misses_the_table_lands_on_the_floor():
    forecast = forecast_flight(rows([-1.5, 0.2, 1.0]), rows([7.0, 0.0, 3.5]), params=VACUUM)
    assert float(forecast.landing[0, 2]) == pytest.approx(0.02, abs=1e-5)
    assert float(forecast.landing[0, 0]) > 1.37
    assert not bool(forecast.landing_own | forecast.landing_opponent)
    assert bool(forecast.bounce_time.isnan())


def test_a_serve_into_the_net_does_not_reach_the_robot():
    forecast = forecast_flight(rows([1.35, 0.0, 0.9]), rows([-5.0, 0.0, 0.5]))
    assert bool(forecast.landing_opponent)
    assert float(forecast.landing[0, 0]) > 0.0
    assert bool(forecast.intercept_time.isnan())


@pytest.mark.parametrize("preset", ["paper", "standard", "venue", "rubber"])
def test_forecast_is_the_simulated_flight(preset: str):
    position, velocity, spin = random_returns(300)
    params = BallParams.preset(preset)
    forecast = forecast_flight(position, velocity, spin, params=params)
    seen = first_contacts(position, velocity, spin, params)
    on_table = forecast.landing_own | forecast.landing_opponent
    assert 50 < int(on_table.sum()) < 290  # both kinds take part
    first_floor = ~(seen["table"] < seen["floor"].nan_to_num(torch.inf))
    assert torch.equal(on_table, ~first_floor)
    landed = torch.where(on_table, seen["table"], seen["floor"])
    known = ~forecast.landing_time.isnan()
    np.testing.assert_allclose(forecast.landing_time[known], landed[known], atol=5e-5)
    np.testing.assert_allclose(forecast.landing[on_table], seen["place"][on_table], atol=2e-4)


def test_the_forecast_moves_on_with_the_flight():
    """Made later in the same flight, it names the same apex."""
    sim = BallSim(1, "cpu", BallParams.preset("rubber"), TABLE, DT, 1, 0.02)
    sim.position.copy_(rows([1.35, 0.05, 1.03]))
    sim.velocity.copy_(rows([-5.8, -0.1, 1.7]))
    first = forecast_flight(sim.position, sim.velocity)
    path = far_path(1, 1)
    for step in range(1, 22):
        sim.fly(path)
        later = forecast_flight(sim.position, sim.velocity)
        np.testing.assert_allclose(later.apex, first.apex, atol=2e-5)
        np.testing.assert_allclose(later.apex_time + step * DT, first.apex_time, atol=1e-5)
        np.testing.assert_allclose(later.intercept, first.intercept, atol=2e-5)


def test_only_masked_worlds_are_forecast():
    sim = BallSim(4, "cpu", BallParams.preset("rubber"), TABLE, DT, 1, 0.02)
    position, velocity = rows([1.35, 0.0, 1.03]).repeat(4, 1), rows([-5.8, 0.0, 1.7]).repeat(4, 1)
    everyone, two = torch.ones(4, dtype=torch.bool), torch.tensor([False, True, False, True])
    sim.forecast(everyone, position, velocity, torch.zeros(4, 3), -1.6)
    before = {f.name: getattr(sim.forecast_result, f.name).clone() for f in fields(Forecast)}
    velocity[:, 1] = 0.3
    sim.forecast(two, position, velocity, torch.zeros(4, 3), -1.6)
    after = sim.forecast_result
    np.testing.assert_array_equal(after.apex[~two], before["apex"][~two])
    assert bool((after.apex[two, 1] > 0.1).all())
    np.testing.assert_array_equal(sim.position, torch.zeros(4, 3))


def test_each_world_has_its_own_parameters():
    params = BallParams.preset("venue")
    drag = torch.tensor([0.46, params.drag_coefficient, 0.68])
    varied = BallParams(**(vars(params) | {"drag_coefficient": drag}))
    position, velocity = rows([1.35, 0.0, 1.03]).repeat(3, 1), rows([-5.8, 0.0, 1.7]).repeat(3, 1)
    together = forecast_flight(position, velocity, params=varied)
    alone = forecast_flight(position[:1], velocity[:1], params=params)
    np.testing.assert_array_equal(together.apex[1], alone.apex[0])
    assert bool((together.bounce[:, 0].diff() > 0.02).all())  # more drag, shorter flight


def test_spin_is_none_or_of_the_same_shape():
    position, velocity = rows([1.35, 0.0, 1.03]), rows([-5.8, 0.0, 1.7])
    none = forecast_flight(position, velocity)
    zero = forecast_flight(position, velocity, torch.zeros(1, 3))
    np.testing.assert_array_equal(none.apex, zero.apex)
    with pytest.raises(ValueError, match=r"velocity must have shape \(N, 3\)"):
        forecast_flight(position, velocity[0])
    with pytest.raises(ValueError, match="spin"):
        forecast_flight(position, velocity, torch.zeros(2, 3))
    with pytest.raises(ValueError, match="num_worlds"):
        forecast_flight(torch.zeros(0, 3), torch.zeros(0, 3))
