"""What an evaluation measures of the quality of play, and the balls that it serves to robots that stood ready."""

from __future__ import annotations

from dataclasses import dataclass

from pace.config.base import require

#: What the ball may do in a pause: keys of ``serve.pause_ball``.
PAUSE_BALL = ("carried", "hidden", "lies")


@dataclass
class QualityConfig:
    """Thresholds and sizes of the table "Quality of play"."""

    range_end: float  # a joint is at its end within this share of its range
    torque_slack: float  # a motor is at its limit within this share of its effort, or of its stall torque
    calm_speed: float  # rad/s, rms over the joints, below which the robot is calm
    after_hit: float  # s after a hit that are the end of the stroke, and no waiting
    sway_window: float  # s, length of the windows whose standard deviations are the sway
    edge: float  # m; landings closer to an edge of the table count as near it
    poses: int  # largest number of poses of a row in which self-contacts are sought

    def __post_init__(self) -> None:
        require(0 < self.range_end < 0.5, f"quality.range_end must lie between 0 and 0.5, got {self.range_end}")
        require(0 <= self.torque_slack < 1, f"quality.torque_slack must lie in [0, 1), got {self.torque_slack}")
        require(self.after_hit >= 0, f"quality.after_hit must not be negative, got {self.after_hit}")
        for name in ("calm_speed", "sway_window", "edge", "poses"):
            require(getattr(self, name) > 0, f"quality.{name} must be positive, got {getattr(self, name)}")


def check_first_ball(waits: list[float], worlds: int, kind: str) -> None:
    """Errors: :class:`ConfigError` for values of ``first_ball``, ``first_ball_worlds`` and ``first_ball_kind`` that
    make no sense."""
    require(min(waits, default=0.0) >= 0, f"first_ball must not hold negative times, got {waits}")
    require(worlds >= 1, f"first_ball_worlds must be at least 1, got {worlds}")
    require(kind in PAUSE_BALL, f"first_ball_kind must be one of {', '.join(PAUSE_BALL)}, got {kind!r}")
