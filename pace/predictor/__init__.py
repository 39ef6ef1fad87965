"""Where the ball will be: the physics-based forecast, and the learned network that the policy sees.

Here belong forecasts of the ball and how the network is fitted; not what the robot makes of them (``onboard``). Imports
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
    """Import on first use, so that the command answers at once."""
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
