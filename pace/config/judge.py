"""How a training run is judged: played without exploration, in worlds of its own."""

from __future__ import annotations

from dataclasses import dataclass

from pace.config.base import require


@dataclass
class JudgeConfig:
    """Judgements of a run: a quick one after each checkpoint, and one at its end.

    They play the task of ``pace evaluate`` (``task=table``) on the CPU, with random numbers of their own: the run's
    weights are the same with and without them.
    """

    serves: int = 128  # of the quick one; 0: none
    worlds: int = 32  # at once in it: few balls a world read a point lower than the last judgement's
    last_serves: int = 500  # of the one at the end; 0: none
    last_worlds: int = 25  # at once in it, 20 balls each as in pace evaluate
    serve: str = "mixed"  # range of configs/serve/
    warmup_serves: int = 2  # first ones of each world, not counted
    physics_dt: float = 0.002  # s
    after: float = 1.0  # minutes: nothing is judged in a shorter run
    video: float = 10.0  # s, of the video at the end; 0: none

    def __post_init__(self) -> None:
        for name in ("serves", "last_serves", "warmup_serves"):
            require(getattr(self, name) >= 0, f"judge.{name} must not be negative, got {getattr(self, name)}")
        for name in ("worlds", "last_worlds"):
            require(getattr(self, name) >= 1, f"judge.{name} must be at least 1, got {getattr(self, name)}")
        require(self.physics_dt > 0, f"judge.physics_dt must be positive, got {self.physics_dt}")
