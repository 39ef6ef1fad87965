"""Where the ball will be: the physics-based forecast, and the learned network that the policy sees.

Here belong forecasts of the ball and how the network is fitted; not what the robot makes of them (``onboard``). Imports
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
