"""The fit of a whole flight: exact on parabolas, close on the task's flights, finite on anything."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError, compose, parse
from pace.config.predictor import FlightFit, PredictorPriors
from pace.config.training import TrainConfig, load_train_config
from pace.predictor.filter import FlightFilter, rebound, solve
from pace.predictor.network import PredictorNetwork
from pace.rl.practice import ServePractice

WINDOW = 45
PRIORS, FIT = PredictorPriors(), FlightFit()
DT = 0.02  # s


def flights(count: int, frames: int) -> tuple[Tensor, Tensor, Tensor]:
    """Two parabolas with the means of the priors: windows (N, 45, 3), bounce times (N,) s, apexes (N, 3)."""
    generator = torch.Generator().manual_seed(3)
    start = torch.tensor([1.35, 0.0, 1.03]).expand(count, 3)
    velocity = torch.tensor([-5.75, -0.2, 1.75]) + 0.2 * (torch.rand(count, 3, generator=generator) - 0.5)
    fall, rise = torch.tensor(PRIORS.fall.mean), torch.tensor(PRIORS.rise.mean)
    drop = velocity[:, 2:].square() - 2 * fall[2] * (start[:, 2:] - FIT.contact_height)
    bounce = (-velocity[:, 2:] - drop.sqrt()) / fall[2]
    place = start + bounce * velocity + 0.5 * bounce**2 * fall
    after = rebound(velocity + bounce * fall, FIT)
    time = DT * torch.arange(frames).view(1, -1, 1)
    late = time - bounce.unsqueeze(1)
    ahead = start.unsqueeze(1) + time * velocity.unsqueeze(1) + 0.5 * time**2 * fall
    behind = place.unsqueeze(1) + late * after.unsqueeze(1) + 0.5 * late**2 * rise
    path = torch.where(late < 0, ahead, behind)
    window = torch.cat([path[:, :1].expand(-1, WINDOW - frames, -1), path], dim=1)
    rising = -after[:, 2:] / rise[2]
    return window, bounce.squeeze(1), place + rising * after + 0.5 * rising**2 * rise


@pytest.mark.parametrize("frames", [6, 15, 21, 27, 33])
def test_it_is_exact_on_its_own_flights(frames: int) -> None:
    window, bounce, apex = flights(50, frames)
    found = FlightFilter(WINDOW, PRIORS, FIT)(window)
    torch.testing.assert_close(found.age, torch.full((50, 1), DT * (frames - 1)))
    torch.testing.assert_close(DT * (frames - 1) - found.bounce_age[:, 0], bounce, atol=2e-3, rtol=0)
    early = 0.06 if frames < 10 else 0.005  # few frames leave the priors' means of the velocity
    assert (found.apex - apex).norm(dim=1).max().item() < early
    used = ((DT * (frames - 1) - bounce) / DT - 0.65).ceil().clamp(min=0)
    assert (found.seen[:, 0] - used).abs().max().item() <= 1


def test_cofactors_solve() -> None:
    factor = torch.randn(20, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.double)
    matrix, vector = factor @ factor.mT + torch.eye(3), factor[:, 0]
    torch.testing.assert_close(solve(matrix, vector), torch.linalg.solve(matrix, vector))


def practice(*overrides: str) -> ServePractice:
    config = parse(compose("predictor_train", ["predictor=filter", "num_worlds=256", *overrides]), TrainConfig)
    return ServePractice(config, torch.device("cpu"))


def test_it_finds_bounce_and_apex_of_the_tasks_flights() -> None:
    """Under the paper's noise and delay: the bounce within 3 ms, the apex within 4.5 cm before any learning."""
    serves = practice("randomization=none", "ball=paper")
    flight_filter, bounced_at = FlightFilter(WINDOW, PRIORS, FIT), torch.full((256,), torch.nan)
    for step in range(1, 35):
        serves.advance()
        bounce = serves.ball.events.own_bounce > 0
        within = serves.ball.events.own_bounce_time
        bounced_at = torch.where(bounce & bounced_at.isnan(), DT * (step - 1) + within, bounced_at)
        if step < 31:
            continue
        found = flight_filter(serves.predictor_input.unflatten(1, (WINDOW, 3)))
        late = (DT * step - found.bounce_age[:, 0]) - bounced_at - DT * serves.sensing.delay
        late = late[bounced_at.isfinite() & serves.predictor_valid]
        assert len(late) > 50
        assert late.mean().abs().item() < 2e-3
        assert late.std().item() < 2e-3
        error = (found.apex - serves.predictor_target[:, :3])[serves.predictor_valid]
        assert error.square().sum(1).mean().sqrt().item() < 0.045


@pytest.mark.parametrize("scale", [0.0, 1.0, 100.0])
def test_the_network_is_finite_on_what_is_no_flight(scale: float) -> None:
    network = PredictorNetwork(load_train_config(["predictor=filter"]).predictor)
    rows = scale * torch.randn(200, 3 * WINDOW, generator=torch.Generator().manual_seed(2))
    assert network(rows).isfinite().all()
    assert network(rows).shape == (200, 7)


def test_untrained_it_predicts_the_apex_that_was_fitted() -> None:
    network = PredictorNetwork(load_train_config(["predictor=filter"]).predictor)
    last = network.layers[-1]
    assert isinstance(last, torch.nn.Linear)
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    window, bounce, apex = flights(20, 33)
    predicted = network(window.flatten(1))
    assert (predicted[:, :3] - apex).norm(dim=1).max().item() < 0.005
    rise = 0.64 + predicted[:, 6] - bounce  # from the bounce to the apex
    assert 0.2 < rise.min().item() < rise.max().item() < 0.3


def test_unknown_features_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"predictor\.features"):
        load_train_config(["predictor.features=fourier"])


def test_the_numbers_of_the_fit_are_configuration() -> None:
    """The YAML holds those of saved predictors, and a duller table is expected to give a lower apex."""
    assert load_train_config(["predictor=filter"]).predictor.fit == FIT
    window = flights(20, 15)[0]  # 0.28 s: before the bounce
    apex = FlightFilter(WINDOW, PRIORS, FIT)(window).apex
    dull = FlightFilter(WINDOW, PRIORS, replace(FIT, restitution=0.8))(window).apex
    # v_z^2 / (2 g) with v_z = e |v|: (0.8 / 0.92)^2 of the rise above the table
    ratio = (dull[:, 2] - FIT.contact_height) / (apex[:, 2] - FIT.contact_height)
    torch.testing.assert_close(ratio, torch.full((20,), (0.8 / 0.92) ** 2), atol=0.02, rtol=0)
    with pytest.raises(ConfigError, match=r"predictor\.fit\.bounce_width needs 3 numbers, got 2"):
        load_train_config(["predictor.fit.bounce_width=[0.1,0.1]"])
