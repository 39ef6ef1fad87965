"""Predicting the ball: the physics-based forecast, and the learned network behind the policy's observations.

Forecasts of the ball and the network's regression belong here, not the robot's use of them (``onboard``). Imports
``sim`` and the rooms below. ``python -m pace.predictor`` trains the network alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pace.predictor.forecast import forecast_flight
    from pace.predictor.network import BallPredictor, PredictorNetwork
    from pace.sim.ball.ball import Forecast

__all__ = ["BallPredictor", "Forecast", "PredictorNetwork", "forecast_flight"]


def __getattr__(name: str) -> Any:
    """Import on first use, so that the command starts fast."""
    if name == "forecast_flight":
        from pace.predictor.forecast import forecast_flight

        return forecast_flight
    if name in ("BallPredictor", "PredictorNetwork"):
        from pace.predictor import network

        return getattr(network, name)
    if name == "Forecast":
        from pace.sim.ball.ball import Forecast

        return Forecast
    raise AttributeError(f"module 'pace.predictor' has no attribute {name!r}")
