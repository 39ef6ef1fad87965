"""The table-tennis task: serves, resets, rewards, observations, predictor."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

from pace.config.base import Range, check_range, require
from pace.config.predictor import PredictorConfig
from pace.config.sim import SensingConfig, SimConfig

#: Axes of a serve's spin, each a key of its own.
SPINS = ("topspin", "sidespin", "corkscrew")


@dataclass
class ServeConfig:
    """Initial position, velocity and spin of serves, and their end."""

    name: str
    x: Range  # m
    y: Range  # m
    z: Range  # m
    vx: Range  # m/s
    vy: Range  # m/s
    vz: Range  # m/s
    topspin: Range  # rad/s, about the horizontal axis across the flight; positive: the ball drops
    sidespin: Range  # rad/s, about the vertical, right-handed about +z
    corkscrew: Range  # rad/s, right-handed about the launch velocity
    max_duration: float  # s since the serve began
    end_after_hit: float  # s after the paddle hit; 0 switches it off
    end_height: float  # m; a ball below it ends the serve
    serves_per_episode: int  # 0: episodes do not end
    random_phase: bool  # first episodes begin at a random serve, to desynchronise the resets
    head_start: Range = field(default_factory=lambda: [0.0, 0.0])  # s of its flight that an episode's first serve skips
    # With more than one attempt, a serve is resampled until it lands first on the robot's half, without the net, and
    # within these limits (null: none), by its forecast; a world without a good one repeats its last.
    attempts: int = 1
    speed: list[float] | None = None  # m/s, of the launch
    bounce_x: list[float] | None = None  # m
    bounce_y: list[float] | None = None  # m
    pause: Range = field(default_factory=lambda: [0.0, 0.0])  # s, from the end of a ball to the next serve
    first_pause: Range = field(default_factory=lambda: [0.0, 0.0])  # s, before the first serve of an episode
    # shares of what the ball does in a pause: :class:`pace.task.pauses.PauseBall`
    pause_ball: dict[str, float] = field(default_factory=lambda: {"lies": 1.0, "carried": 0.0, "hidden": 0.0})

    def __post_init__(self) -> None:
        for name in ("x", "y", "z", "vx", "vy", "vz", *SPINS):
            check_range(f"serve.{name}", getattr(self, name))
        check_range("serve.head_start", self.head_start, 0.0)
        self._check_attempts()
        self._check_pauses()
        require(self.max_duration > 0, "serve.max_duration must be positive")
        require(self.serves_per_episode >= 0, "serve.serves_per_episode must be 0 (no end) or more")

    def limits(self) -> dict[str, Range]:
        """The ranges that limit which samples are accepted, by name."""
        named = {"speed": self.speed, "bounce_x": self.bounce_x, "bounce_y": self.bounce_y}
        return {name: limit for name, limit in named.items() if limit is not None}

    @property
    def has_pauses(self) -> bool:
        """Serves may have to wait."""
        return max(self.pause[1], self.first_pause[1]) > 0

    def _check_pauses(self) -> None:
        check_range("serve.pause", self.pause, 0.0)
        check_range("serve.first_pause", self.first_pause, 0.0)
        given = sorted(self.pause_ball)
        known = given == ["carried", "hidden", "lies"]
        require(known, f"serve.pause_ball needs exactly carried, hidden, lies; got {', '.join(given)}")
        shares = self.pause_ball.values()
        whole = min(shares) >= 0 and math.isclose(sum(shares), 1.0, abs_tol=1e-6)
        require(whole, f"serve.pause_ball: the shares must not be negative and must sum to 1, got {self.pause_ball}")

    def _check_attempts(self) -> None:
        require(self.attempts >= 1, f"serve.attempts must be at least 1, got {self.attempts}")
        for name, limit in self.limits().items():
            check_range(f"serve.{name}", limit)
            require(self.attempts > 1, f"serve.{name} needs serve.attempts above 1: it limits what is resampled")


@dataclass
class ResetConfig:
    """Initial state of the robot, and the bounds that end an episode."""

    base_x: Range  # m, world
    base_y: Range  # m, world
    yaw: Range  # rad
    linear_velocity: Range  # m/s, each axis
    roll_pitch_rate: Range  # rad/s
    yaw_rate: Range  # rad/s
    joint_scale: Range  # legs, waist and left arm: nominal times this
    right_arm_offset: Range  # rad: right arm: nominal plus this
    min_base_height: float  # m; below it the robot has fallen
    bounds_x: Range  # m
    bounds_y: Range  # m

    def __post_init__(self) -> None:
        for f in fields(self):
            if f.name != "min_base_height":
                check_range(f"reset.{f.name}", getattr(self, f.name))


@dataclass
class RewardTerm:
    """One term: its weight, multiplied by the control step, its numbers, and its function.

    ``function``: name of a term or import path ``my_module:my_term``; null: the term of the same name.
    """

    weight: float
    params: dict[str, float] = field(default_factory=dict)
    function: str | None = None


@dataclass
class RewardConfig:
    """The reward: its terms by name, the shared target of the hit terms, and the scale of the learner's reward."""

    name: str
    scale: float  # the learner's reward is scale * sum of the terms
    target_x: float  # m; the paddle's target is the apex, or the later point at which the ball passes this x
    target_mode: str  # "intercept": later of apex and x = target_x; "clamp": apex with its x clamped (released code)
    arm_offset: list[float]  # m; base target = target_xy + arm_offset
    idle_base_xy: list[float]  # m; base target while there is nothing to hit
    idle_height: float  # m; height of the paddle's target meanwhile
    nothing_to_hit: dict[str, float]  # past_x, low_z, falling_x (m): when the prediction terms are off
    terms: dict[str, RewardTerm]

    def __post_init__(self) -> None:
        require(self.target_mode in ("intercept", "clamp"), "reward.target_mode must be intercept or clamp")
        for name in ("arm_offset", "idle_base_xy"):
            require(len(getattr(self, name)) == 2, f"reward.{name} needs two numbers, got {getattr(self, name)}")
        given, needed = sorted(self.nothing_to_hit), ["falling_x", "low_z", "past_x"]
        require(given == needed, f"reward.nothing_to_hit needs exactly {', '.join(needed)}; got {', '.join(given)}")


@dataclass
class ReturnMemoryConfig:
    """Numbers of the memory of returns (:class:`pace.onboard.returns.ReturnMemory`)."""

    prior: float  # restitution before the first hit
    prior_hits: float  # weight of the prior, in hits
    hits: float  # with more hits than this, older ones fade
    reach: float  # m; a ball that turns farther from the paddle was turned by something else
    closing_speed: float  # m/s along the normal; slower hits are ignored
    largest: float  # largest single estimate

    def __post_init__(self) -> None:
        for name in ("prior_hits", "reach", "closing_speed", "largest"):
            require(getattr(self, name) > 0, f"observation.return_memory.{name} must be positive")
        require(self.hits >= 1, "observation.return_memory.hits must be at least 1")
        require(0 <= self.prior <= self.largest, "observation.return_memory.prior must lie in [0, largest]")


@dataclass
class RubberMemoryConfig(ReturnMemoryConfig):
    """Numbers of the memory of returns and of the rubber's grip (:class:`pace.onboard.rubber.RubberMemory`)."""

    bounce_spin: float  # rad/s, topspin that a ball is taken to have when it is hit
    radius: float  # m, of the ball
    prior_grip: float  # share of the slip that a contact takes, before the first hit
    slip: float  # m/s; hits with less of it are ignored
    largest_grip: float  # largest single estimate

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("radius", "slip", "largest_grip"):
            require(getattr(self, name) > 0, f"observation.rubber_memory.{name} must be positive")
        require(self.bounce_spin >= 0, "observation.rubber_memory.bounce_spin must not be negative")
        require(0 <= self.prior_grip <= self.largest_grip, "observation.rubber_memory.prior_grip: 0 to largest_grip")


@dataclass
class DelayEstimateConfig:
    """Numbers of the estimate of motion capture's delay (:class:`pace.onboard.delay.DelayEstimate`)."""

    prior: float  # s, before the first observation
    prior_worth: float  # rad^2/s^2, weight of the prior, as a sum of squared changes of the yaw rate
    smoothing: float  # share of the filtered turns that is left a control step later
    fading: float  # share of the sums that is left a control step later

    def __post_init__(self) -> None:
        require(self.prior >= 0, f"observation.delay_estimate.prior must not be negative, got {self.prior}")
        require(self.prior_worth > 0, "observation.delay_estimate.prior_worth must be positive")
        for name in ("smoothing", "fading"):
            value = getattr(self, name)
            require(0 < value <= 1, f"observation.delay_estimate.{name} must lie in (0, 1], got {value}")


@dataclass
class AttitudeEstimateConfig:
    """Numbers of the orientation filter (:class:`pace.onboard.attitude.AttitudeEstimate`)."""

    gain: float  # share of the sensed value in each control step's estimate; the rest is the rotated last estimate

    def __post_init__(self) -> None:
        require(0 < self.gain <= 1, f"observation.attitude_estimate.gain must lie in (0, 1], got {self.gain}")


@dataclass
class JointEstimateConfig:
    """Numbers of the joint filter (:class:`pace.onboard.joints.JointEstimate`)."""

    acceleration: float  # rad/s^2, root mean square over a control step
    position_noise: float  # rad, root mean square, of the sensed positions
    velocity_noise: float  # rad/s, the same

    def __post_init__(self) -> None:
        for name in ("acceleration", "position_noise", "velocity_noise"):
            value = getattr(self, name)
            good = 0 < value < math.inf
            require(good, f"observation.joint_estimate.{name} must be positive and finite, got {value}")


@dataclass
class ObservationConfig:
    """Names of the observations of each network, in order, and the control steps of history of each."""

    name: str
    policy: list[str]
    critic: list[str]
    policy_history: int
    critic_history: int
    # numbers of the estimates (pace.onboard.estimates), each needed if the policy observes it
    return_memory: ReturnMemoryConfig | None = None
    delay_estimate: DelayEstimateConfig | None = None
    attitude_estimate: AttitudeEstimateConfig | None = None
    joint_estimate: JointEstimateConfig | None = None
    rubber_memory: RubberMemoryConfig | None = None
    estimates: dict[str, Any] = field(default_factory=dict)  # of those that are registered from outside, by their key

    def built_in(self) -> dict[str, Any]:
        """Numbers of the package's own estimates by key; ``None`` if they are not given."""
        return {
            "return_memory": self.return_memory,
            "delay_estimate": self.delay_estimate,
            "attitude_estimate": self.attitude_estimate,
            "joint_estimate": self.joint_estimate,
            "rubber_memory": self.rubber_memory,
        }

    def numbers(self) -> dict[str, Any]:
        """The same and those from outside, which are dictionaries until they are parsed."""
        return self.estimates | self.built_in()

    def __post_init__(self) -> None:
        for name in ("policy", "critic"):
            require(len(getattr(self, name)) > 0, f"observation.{name} must name at least one")
        require(self.policy_history >= 1, "observation.policy_history must be at least 1")
        require(self.critic_history >= 1, "observation.critic_history must be at least 1")


@dataclass
class TaskConfig(SimConfig):
    """The table-tennis task: the worlds, their serves, sensors and rewards."""

    serve: ServeConfig
    reset: ResetConfig
    reward: RewardConfig
    sensing: SensingConfig
    observation: ObservationConfig
    predictor: PredictorConfig
    landing_target: list[float]  # m, x and y: target of returns on the opponent's half

    def __post_init__(self) -> None:
        require(len(self.landing_target) == 2, f"landing_target needs two numbers, got {self.landing_target}")
