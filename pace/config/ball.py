"""Configuration of the ball: table, air, contacts."""

from __future__ import annotations

from dataclasses import dataclass

from pace.config.base import require


@dataclass
class TableConfig:
    """Table, net, floor, paddle and the robot's body for the ball's collisions; world frame, origin under the table's
    centre. The numbers of body and push apply to policies saved before they existed too: they are rules of the game."""

    length: float  # m, along x
    width: float  # m, along y
    height: float  # m, top above the floor
    thickness: float  # m
    net_height: float  # m above the top
    net_overhang: float  # m past each side line
    paddle_radius: float  # m
    paddle_half_thickness: float  # m, blade and rubber
    floor_restitution: float
    floor_friction: float
    net_restitution: float
    net_friction: float
    body_restitution: float = 0.8  # of the robot's body, arms and head
    body_friction: float = 0.25
    push_force: float = 100.0  # N, mean over a control step: a robot that pushes harder moves the table

    def __post_init__(self) -> None:
        require(0 <= self.body_restitution <= 1, "ball.table.body_restitution must lie in [0, 1]")
        require(self.body_friction >= 0, "ball.table.body_friction must not be negative")
        require(self.push_force > 0, "ball.table.push_force must be positive")


@dataclass
class DragRow:
    """C_d at one speed: linear in the spin ratio S = r |omega| / |v| between the knots, held beyond them."""

    speed: float  # m/s
    ratio: list[float]
    coefficient: list[float]

    def __post_init__(self) -> None:
        knots = f"ball.air.drag at {self.speed} m/s"
        require(
            len(self.ratio) == len(self.coefficient) > 1, f"{knots}: needs as many ratios as coefficients, 2 or more"
        )
        require(self.ratio == sorted(set(self.ratio)), f"{knots}: ratios must grow, got {self.ratio}")
        require(min(self.coefficient) >= 0, f"{knots}: a coefficient must not be negative, got {self.coefficient}")


@dataclass
class LiftRow:
    """C_M at one speed: slope omega + offset up to the spin ``bend``, above it a parabola."""

    speed: float  # m/s
    slope: float  # s/rad
    offset: float
    bend: float  # rad/s
    quadratic: float  # s^2/rad^2
    linear: float  # s/rad
    constant: float


@dataclass
class AirConfig:
    """Measured coefficients of drag and lift, by rows of growing speed; linear in speed between the rows."""

    drag: list[DragRow]
    lift: list[LiftRow]

    def __post_init__(self) -> None:
        for name in ("drag", "lift"):
            speeds = [row.speed for row in getattr(self, name)]
            require(len(speeds) >= 2, f"ball.air.{name} needs at least two rows")
            require(speeds == sorted(set(speeds)), f"ball.air.{name}: the speeds of the rows must grow, got {speeds}")
        knots = {len(row.ratio) for row in self.drag}
        require(len(knots) == 1, f"ball.air.drag: every row needs the same number of knots, got {sorted(knots)}")


@dataclass
class BallConfig:
    """Ball, air and contacts (:class:`pace.sim.ball.BallParams`).

    The defaults are those of policies saved before rubber sprang back: constant coefficients of the air, no springing.
    """

    name: str
    mass: float  # kg
    radius: float  # m
    air_density: float  # kg / m^3
    drag_coefficient: float
    magnus_coefficient: float
    table_restitution: float
    table_restitution_slope: float  # s / m
    table_friction: float
    paddle_restitution: float
    paddle_restitution_slope: float  # s / m
    paddle_friction: float
    table: TableConfig
    min_restitution: float = 0.0
    table_drag: float = 0.0  # share of the measured C_d in air.drag, added to drag_coefficient
    table_lift: float = 0.0  # share of the measured C_M in air.lift
    table_tangential_restitution: float = 0.0  # share of the slip that is reversed; 0: the ball rolls
    paddle_tangential_restitution: float = 0.0
    paddle_tangential_restitution_slope: float = 0.0  # s / m, times the speed of the slip
    paddle_drilling_loss: float = 0.0  # share of the spin about the paddle's normal that a hit takes
    air: AirConfig | None = None

    def __post_init__(self) -> None:
        for name in ("table_drag", "table_lift", "paddle_tangential_restitution_slope"):
            require(getattr(self, name) >= 0, f"ball.{name} must not be negative, got {getattr(self, name)}")
        for name in ("table_tangential_restitution", "paddle_tangential_restitution"):
            value = getattr(self, name)
            require(-1 <= value <= 1, f"ball.{name} must lie in [-1, 1], got {value}: more would create energy")
        loss = self.paddle_drilling_loss
        require(0 <= loss <= 1, f"ball.paddle_drilling_loss must lie in [0, 1], got {loss}")
        needed = self.air is not None or self.table_drag == self.table_lift == 0
        require(needed, "ball.table_drag and ball.table_lift need the tables of ball.air (configs/ball/_air.yaml)")
        for name in ("mass", "radius"):
            require(getattr(self, name) > 0, f"ball.{name} must be positive")
        for name in ("table_restitution", "paddle_restitution"):
            require(0 <= getattr(self, name) <= 1, f"ball.{name} must lie in [0, 1]")
