"""Where the ball will be: the physics-based forecast, and the learned network that the policy sees."""

from pace.predictor.forecast import forecast_flight
from pace.predictor.network import BallPredictor, PredictorNetwork
from pace.sim.ball.ball import Forecast

__all__ = ["BallPredictor", "Forecast", "PredictorNetwork", "forecast_flight"]
