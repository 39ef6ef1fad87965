"""The learned predictor: its configuration, and its priors of the serves."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from pace.config import plugins
from pace.config.base import require

COUNTED_FRAMES = 5  # the last positions that ``predictor.features=counted`` takes


FEATURES = ("steps", "counted", "flight")


FRAME_DT = 0.02  # s, between the positions that ``predictor.features=flight`` fits


@dataclass
class Prior:
    """Mean (centre) and standard deviation (scale) of a quantity, by axis."""

    mean: list[float]
    std: list[float]

    def __post_init__(self) -> None:
        require(len(self.mean) == len(self.std), f"predictor.priors: {len(self.mean)} means, {len(self.std)} stds")
        require(min(self.std, default=1.0) > 0, f"predictor.priors: a std must be positive, got {self.std}")


@dataclass
class PredictorPriors:
    """The predictor's priors of the serves (world frame; x, y, z): the scales of its numbers.

    A network's weights belong to the priors that it was trained with, so these are saved with it. The defaults were
    measured on the released training serves; :mod:`pace.predictor.priors` transfers them to other serves. Saved
    predictors without priors were trained with the defaults.
    """

    # of the fit (features=flight): the launch, whose position is sensed; both accelerations, of drag 4 m/s^2 at 6 m/s
    launch_velocity: Prior = field(default_factory=lambda: Prior([-5.75, -0.2, 1.75], [0.6, 0.5, 0.25]))  # m/s
    fall: Prior = field(default_factory=lambda: Prior([4.0, 0.0, -9.8], [0.8, 0.2, 0.3]))  # m/s^2, before the bounce
    rise: Prior = field(default_factory=lambda: Prior([2.0, 0.0, -10.4], [0.4, 0.2, 0.4]))  # m/s^2, after it
    # results of the fit: velocities before and after the bounce, and its position
    fall_velocity: Prior = field(default_factory=lambda: Prior([-5.2, -0.2, -0.5], [0.5, 0.35, 1.5]))  # m/s
    rise_velocity: Prior = field(default_factory=lambda: Prior([-4.1, -0.15, 2.6], [0.5, 0.3, 0.25]))  # m/s
    bounce: Prior = field(default_factory=lambda: Prior([-1.0, -0.1, 0.78], [0.25, 0.2, 0.02]))  # m
    # a serve crosses the table (|x| <= 1.37, |y| <= 0.76) between its top and about 0.5 m above it
    position: Prior = field(default_factory=lambda: Prior([0.0, 0.0, 1.0], [1.0, 0.4, 0.25]))  # m
    # times, as features: since the launch in seconds and in frames, and since the bounce in frames
    age: Prior = field(default_factory=lambda: Prior([0.35], [0.25]))  # s
    count: Prior = field(default_factory=lambda: Prior([20.0], [10.0]))
    bounced: Prior = field(default_factory=lambda: Prior([0.0], [6.0]))
    # between two frames (20 ms), in which serves differ by a few centimetres
    step: Prior = field(default_factory=lambda: Prior([-0.11, 0.0, 0.0], [0.02, 0.02, 0.03]))  # m
    # outputs: the apex lies at or behind the robot's end of the table
    apex: Prior = field(default_factory=lambda: Prior([-1.5, 0.0, 1.0], [0.3, 0.25, 0.12]))  # m
    target: Prior = field(default_factory=lambda: Prior([-1.6, 0.0, 1.0], [0.25, 0.25, 0.15]))  # m
    target_time: Prior = field(default_factory=lambda: Prior([0.3], [0.25]))  # s

    def __post_init__(self) -> None:
        for f in fields(self):
            size = 1 if f.name in ("age", "count", "bounced", "target_time") else 3
            require(len(getattr(self, f.name).mean) == size, f"predictor.priors.{f.name} needs {size} numbers each")


@dataclass
class FlightFit:
    """Numbers of the fit of a whole flight (:mod:`pace.predictor.filter`). The defaults are those of predictors that
    were saved before these were configuration.

    Attributes: ``noise`` m, standard deviation of a sensed position; ``contact_height`` m, of a ball's centre on the
    table; ``low`` m, a ball that starts to rise below it has bounced; ``after_bounce`` s, positions that follow a
    bounce sooner are on neither parabola; ``least_gravity`` m/s^2 downwards; standard deviations (x, y, z) of the
    priors: ``launch_width`` m of the first position, ``bounce_width`` m and ``rebound_width`` m/s of position and
    velocity after the bounce; ``restitution`` and ``friction`` of the table.
    """

    noise: float = 0.004
    contact_height: float = 0.78
    low: float = 0.9
    after_bounce: float = 0.013
    least_gravity: float = 5.0
    launch_width: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0])
    bounce_width: list[float] = field(default_factory=lambda: [0.003, 0.003, 0.003])
    rebound_width: list[float] = field(default_factory=lambda: [0.25, 0.06, 0.06])
    restitution: float = 0.92
    friction: float = 0.225

    def __post_init__(self) -> None:
        for name in ("launch_width", "bounce_width", "rebound_width"):
            width = getattr(self, name)
            require(len(width) == 3, f"predictor.fit.{name} needs 3 numbers, got {len(width)}")


@dataclass
class PredictorConfig:
    """The learned predictor of the ball's apex and its online regression."""

    name: str
    frames: int  # past ball positions in its input
    hidden: list[int]
    learning_rate: float
    batch_size: int
    batches_per_update: int
    train_updates: int  # frozen afterwards; 0 trains it to the end
    outputs: list[str]  # of apex (3), target (3), target_time (1)
    enabled: bool  # off: the actor gets zeros instead (ablation)
    features: str = "steps"  # steps (positions alone), counted (the last five, and how many there were before them) or
    # flight (a fit of the whole flight), which both need many frames; or from outside: my_module:MyPredictor
    priors: PredictorPriors | None = None  # null: derived from the serve when a run starts, and saved with it
    fit: FlightFit = field(default_factory=FlightFit)  # of features=flight, and of the priors that are derived

    def __post_init__(self) -> None:
        known = self.features in FEATURES or plugins.may_be_outside(plugins.PREDICTORS, self.features)
        wanted = "steps, counted or flight, or come from a module named in plugins=[...]"
        require(known, f"predictor.features must be {wanted}, not {self.features!r}")
        enough = self.features != "counted" or self.frames > COUNTED_FRAMES
        require(enough, f"predictor.features=counted needs more than {COUNTED_FRAMES} frames, got {self.frames}")
        require(self.learning_rate > 0, "predictor.learning_rate must be positive")
        for name in ("batch_size", "batches_per_update"):
            require(getattr(self, name) >= 1, f"predictor.{name} must be at least 1, got {getattr(self, name)}")
        require(min(self.hidden, default=1) >= 1, "predictor.hidden: a layer has at least 1 unit")
