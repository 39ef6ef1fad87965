"""PACE: humanoid table tennis by predictor-aided reinforcement learning, on MuJoCo Warp and TorchRL."""

__version__ = "0.1.0"
