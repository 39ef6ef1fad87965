"""The ball: its flight through the air, its rebounds, and the forecast of both.

Public names: :class:`BallParams` (with ``preset``), :class:`BallSim`, :class:`Forecast`. The ball's motion belongs
here, not the rules of the game (``task``). Imports ``arrays`` and the rooms below.
"""

from pace.sim.ball.ball import BallParams, BallSim, Forecast, ball_preset

__all__ = ["BallParams", "BallSim", "Forecast", "ball_preset"]
