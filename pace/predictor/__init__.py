"""Predicting the ball: the physics-based forecast, and the learned network behind the policy's observations.

Forecasts of the ball and the network's regression belong here, not the robot's use of them (``onboard``). Imports
``sim`` and the rooms below. ``python -m pace.predictor`` trains the network alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pace.lazy import on_first_use

if TYPE_CHECKING:
    from pace.predictor.forecast import forecast_flight
    from pace.predictor.network import BallPredictor, PredictorNetwork
    from pace.sim.ball.ball import Forecast

__all__ = ["BallPredictor", "Forecast", "PredictorNetwork", "forecast_flight"]

__getattr__ = on_first_use(
    __name__,
    {
        "BallPredictor": "pace.predictor.network",
        "Forecast": "pace.sim.ball.ball",
        "PredictorNetwork": "pace.predictor.network",
        "forecast_flight": "pace.predictor.forecast",
    },
)
