"""Forecasts of balls of any numbers: events, or NaN for those that do not occur."""

from __future__ import annotations

import torch
from torch import Tensor

from pace.predictor.forecast import forecast_flight
from tests.helpers.examples import any_vectors, check, counts_of

SERVED = torch.tensor([[1.3, 0.0, 1.0], [-6.0, 0.0, 1.5], [0.0, 0.0, 0.0]])


def forecast(first: Tensor) -> dict[str, Tensor]:
    """Of the ball ``first``, (3, 3), beside one that is served."""
    position, velocity, spin = (torch.stack(pair) for pair in zip(first, SERVED, strict=True))
    found = vars(forecast_flight(position, velocity, spin))
    return {name: value.clone() for name, value in found.items() if isinstance(value, Tensor)}


@counts_of(1000, 5000)
def test_any_ball_has_a_forecast_and_others_do_not_notice(count: int) -> None:
    alone = forecast(SERVED)
    assert alone

    @check(count, any_vectors(), any_vectors(), any_vectors())
    def example(place: list[float], velocity: list[float], spin: list[float]) -> None:
        for name, value in forecast(torch.tensor([place, velocity, spin])).items():
            assert not bool(value.isinf().any()), name
            assert torch.equal(value[1].nan_to_num(), alone[name][1].nan_to_num()), name
