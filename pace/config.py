"""Typed configuration: one dataclass per group of ``configs/``, and the check of YAML against it.

Every number of the task, the physics and the learning lives in the YAML files, with its unit and source. The classes
here say which keys exist and of what type they are; an unknown key, a wrong type or a value out of range raises
:class:`ConfigError` with the key's full name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

Range = list[float]
T = TypeVar("T")


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the key and the cure."""


def config_dir() -> Path:
    """Folder of the YAML files: inside an installed wheel, or at the root of a checkout."""
    here = Path(__file__).resolve().parent
    for candidate in (here / "configs", here.parent / "configs"):
        if candidate.is_dir():
            return candidate
    raise ConfigError(f"no configs/ folder beside {here}: reinstall pace-table-tennis or run from a checkout")


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)


def _check_range(name: str, value: Range, lowest: float | None = None) -> None:
    _require(len(value) == 2, f"{name} must be [low, high], got {value}")
    _require(value[0] <= value[1], f"{name}: low {value[0]} is above high {value[1]}")
    if lowest is not None:
        _require(value[0] >= lowest, f"{name}: {value[0]} is below {lowest}")


@dataclass
class JointGroup:
    """Gains and limits of the joints whose name contains one of ``match``."""

    match: list[str]
    kp: float  # N m / rad
    kd: float  # N m s / rad
    effort: float  # N m
    max_speed: float = 0.0  # rad/s, at which the motor gives no torque; needed where robot.stall_ratio is on


@dataclass
class RobotConfig:
    """The robot: control rate, gains, nominal pose."""

    name: str
    control_dt: float  # s
    action_scale: float  # rad per unit of action
    action_clip: float  # largest |action|
    armature: float  # kg m^2
    base_height: float  # m, base above the floor at reset
    joint_groups: list[JointGroup]  # the first match of a joint counts
    nominal_pose: dict[str, float]  # rad; joints not named stand at 0
    stall_ratio: float = 0.0  # stall torque over effort; 0: full effort at any speed, as before there was a limit

    def __post_init__(self) -> None:
        _require(self.control_dt > 0, "robot.control_dt must be positive")
        known = self.stall_ratio == 0 or 1 <= self.stall_ratio < math.inf
        _require(known, f"robot.stall_ratio must be 0 (no limit) or a number from 1 on, got {self.stall_ratio}")
        slow = [group.match for group in self.joint_groups if group.max_speed <= 0]
        _require(not (self.stall_ratio and slow), f"robot.stall_ratio needs the max_speed of the joint groups {slow}")
        _require(self.action_clip > 0, "robot.action_clip must be positive")


@dataclass
class TableConfig:
    """Table, net, floor and paddle as the ball meets them; world frame, origin under the table's centre."""

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


@dataclass
class BallConfig:
    """Ball, air and contacts. Restitution is ``e0 - slope * |v_n|``, never below ``min_restitution``."""

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

    def __post_init__(self) -> None:
        for name in ("mass", "radius"):
            _require(getattr(self, name) > 0, f"ball.{name} must be positive")
        for name in ("table_restitution", "paddle_restitution"):
            _require(0 <= getattr(self, name) <= 1, f"ball.{name} must lie in [0, 1]")


@dataclass
class ServeConfig:
    """Where serves start and how fast they are, and when a serve is over."""

    name: str
    x: Range  # m
    y: Range  # m
    z: Range  # m
    vx: Range  # m/s
    vy: Range  # m/s
    vz: Range  # m/s
    spin: Range  # rad/s, each axis
    max_duration: float  # s since the serve began
    end_after_hit: float  # s after the paddle hit; 0 switches it off
    end_height: float  # m; a ball below it ends the serve
    serves_per_episode: int  # 0: the worlds play on without end
    random_phase: bool  # first episodes begin at a random serve, so that resets spread over time
    head_start: Range = field(default_factory=lambda: [0.0, 0.0])  # s of its flight that an episode's first serve skips

    def __post_init__(self) -> None:
        for name in ("x", "y", "z", "vx", "vy", "vz", "spin"):
            _check_range(f"serve.{name}", getattr(self, name))
        _check_range("serve.head_start", self.head_start, 0.0)
        _require(self.max_duration > 0, "serve.max_duration must be positive")
        _require(self.serves_per_episode >= 0, "serve.serves_per_episode must be 0 (no end) or more")


@dataclass
class ResetConfig:
    """Where the robot starts, and where an episode is lost."""

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
                _check_range(f"reset.{f.name}", getattr(self, f.name))


@dataclass
class RewardTerm:
    """One term: its weight, multiplied by the control step, and the numbers that it needs."""

    weight: float
    params: dict[str, float] = field(default_factory=dict)


@dataclass
class RewardConfig:
    """The reward: its terms by name, the target that the hit terms share, and the scale that the learner sees."""

    name: str
    scale: float  # the learner sees scale * sum of the terms
    target_x: float  # m; the paddle's target is the apex, or where the ball later passes this x
    target_mode: str  # "intercept": later of apex and x = target_x; "clamp": apex with its x clamped (released code)
    arm_offset: list[float]  # m; base target = target_xy + arm_offset
    idle_base_xy: list[float]  # m; base target while there is nothing to hit
    idle_height: float  # m; height of the paddle's target meanwhile
    nothing_to_hit: dict[str, float]  # past_x, low_z, falling_x (m): when the prediction terms are off
    terms: dict[str, RewardTerm]

    def __post_init__(self) -> None:
        _require(self.target_mode in ("intercept", "clamp"), "reward.target_mode must be intercept or clamp")
        for name in ("arm_offset", "idle_base_xy"):
            _require(len(getattr(self, name)) == 2, f"reward.{name} needs two numbers, got {getattr(self, name)}")
        given, needed = sorted(self.nothing_to_hit), ["falling_x", "low_z", "past_x"]
        _require(given == needed, f"reward.nothing_to_hit needs exactly {', '.join(needed)}; got {', '.join(given)}")


@dataclass
class RandomizationConfig:
    """Per-world draws at each reset. ``[1, 1]`` scales and ``[0, 0]`` offsets are a clean run."""

    name: str
    friction: Range  # sliding friction of robot bodies with floor and table
    trunk_mass: Range  # kg added
    trunk_com: Range  # m added, each axis
    kp_scale: Range
    kd_scale: Range
    armature_scale: Range
    effort_scale: Range
    actuator_delay: Range  # s
    push_velocity: Range  # m/s, x and y, added to the base
    push_interval: Range  # s between pushes; [0, 0] is no push
    ball_mass_scale: Range
    drag_scale: Range
    magnus: Range  # added to the Magnus coefficient
    table_restitution: Range  # added
    table_friction: Range  # added
    paddle_restitution: Range  # added
    paddle_friction: Range  # added

    def __post_init__(self) -> None:
        for f in fields(self):
            if f.name != "name":
                _check_range(f"randomization.{f.name}", getattr(self, f.name))
        _require(self.effort_scale[0] > 0, "randomization.effort_scale must be positive")


@dataclass
class SensingConfig:
    """What the robot's sensors add to the truth: uniform noise (+- amplitude) and delay."""

    name: str
    base_angular_velocity: float  # rad/s
    base_position: float  # m
    projected_gravity: float
    joint_position: float  # rad
    joint_velocity: float  # rad/s
    ball_position: float  # m
    heading: float
    base_shift: float  # m
    mocap_delay: Range  # s, drawn per world at reset: ball, base position and heading
    noise_scale: Range = field(default_factory=lambda: [1.0, 1.0])  # of all amplitudes, drawn per world at reset
    moved: float = 0.03  # m; a ball seen so much further away than two control steps before has turned: noise does less

    def __post_init__(self) -> None:
        _check_range("sensing.mocap_delay", self.mocap_delay, lowest=0.0)
        _check_range("sensing.noise_scale", self.noise_scale, lowest=0.0)
        _require(self.moved >= 0, f"sensing.moved must not be negative, got {self.moved}")


@dataclass
class ReturnMemoryConfig:
    """What the robot remembers of its own returns (:class:`pace.rl.memory.ReturnMemory`)."""

    prior: float  # restitution before the first hit
    prior_hits: float  # hits that the prior is worth
    hits: float  # older hits fade once there are that many
    reach: float  # m; a ball further from the paddle when it is seen to turn was turned by something else
    closing_speed: float  # m/s along the normal; a slower hit tells nothing
    largest: float  # largest single estimate

    def __post_init__(self) -> None:
        for name in ("prior_hits", "reach", "closing_speed", "largest"):
            _require(getattr(self, name) > 0, f"observation.return_memory.{name} must be positive")
        _require(self.hits >= 1, "observation.return_memory.hits must be at least 1")
        _require(0 <= self.prior <= self.largest, "observation.return_memory.prior must lie in [0, largest]")


@dataclass
class DelayEstimateConfig:
    """How the robot finds out how late its motion capture is (:class:`pace.rl.delay.DelayEstimate`)."""

    prior: float  # s, before anything was seen
    prior_worth: float  # rad^2/s^2, sum of squared changes of the yaw rate that the prior is worth
    smoothing: float  # share of the filtered turns that is left a control step later
    fading: float  # share of the sums that is left a control step later

    def __post_init__(self) -> None:
        _require(self.prior >= 0, f"observation.delay_estimate.prior must not be negative, got {self.prior}")
        _require(self.prior_worth > 0, "observation.delay_estimate.prior_worth must be positive")
        for name in ("smoothing", "fading"):
            value = getattr(self, name)
            _require(0 < value <= 1, f"observation.delay_estimate.{name} must lie in (0, 1], got {value}")


@dataclass
class AttitudeEstimateConfig:
    """How the robot knows its orientation better than its sensors (:class:`pace.rl.attitude.AttitudeEstimate`)."""

    gain: float  # share of what is sensed in each control step's estimate; the rest is the last one, turned on

    def __post_init__(self) -> None:
        _require(0 < self.gain <= 1, f"observation.attitude_estimate.gain must lie in (0, 1], got {self.gain}")


@dataclass
class JointEstimateConfig:
    """How the robot knows its joints better than its encoders (:class:`pace.rl.joints.JointEstimate`)."""

    acceleration: float  # rad/s^2, root mean square over a control step
    position_noise: float  # rad, root mean square, of what is sensed
    velocity_noise: float  # rad/s, the same

    def __post_init__(self) -> None:
        for name in ("acceleration", "position_noise", "velocity_noise"):
            value = getattr(self, name)
            good = 0 < value < math.inf
            _require(good, f"observation.joint_estimate.{name} must be positive and finite, got {value}")


#: Numbers of the observation's configuration -> the actor's observations that need them.
OBSERVED_FROM = {
    "return_memory": ("last_return",),
    "delay_estimate": ("sensed_delay",),
    "attitude_estimate": ("estimated_gravity", "estimated_heading"),
    "joint_estimate": ("estimated_joint_position", "estimated_joint_velocity"),
}


@dataclass
class ObservationConfig:
    """Names of the observations of each network, in order, and how many control steps of history each sees."""

    name: str
    policy: list[str]
    critic: list[str]
    policy_history: int
    critic_history: int
    # each needed by its observations of OBSERVED_FROM; the last two, observed, give the paddle's pose too
    return_memory: ReturnMemoryConfig | None = None
    delay_estimate: DelayEstimateConfig | None = None
    attitude_estimate: AttitudeEstimateConfig | None = None
    joint_estimate: JointEstimateConfig | None = None

    @property
    def memory(self) -> ReturnMemoryConfig | None:
        """Numbers of the memory of returns, where the policy observes it."""
        return self.return_memory if self.observed_from("return_memory") else None

    @property
    def delay(self) -> DelayEstimateConfig | None:
        """Numbers of the estimate of the delay, where the policy observes it."""
        return self.delay_estimate if self.observed_from("delay_estimate") else None

    @property
    def attitude(self) -> AttitudeEstimateConfig | None:
        """Numbers of the filter of the orientation, where the policy observes it."""
        return self.attitude_estimate if self.observed_from("attitude_estimate") else None

    @property
    def joints(self) -> JointEstimateConfig | None:
        """Numbers of the filter of the joints, where the policy observes it."""
        return self.joint_estimate if self.observed_from("joint_estimate") else None

    def observed_from(self, numbers: str) -> list[str]:
        """Which of the policy's observations need these numbers, a key of ``OBSERVED_FROM``."""
        return [name for name in OBSERVED_FROM[numbers] if name in self.policy]

    def __post_init__(self) -> None:
        for name in ("policy", "critic"):
            _require(len(getattr(self, name)) > 0, f"observation.{name} must name at least one")
        _require(self.policy_history >= 1, "observation.policy_history must be at least 1")
        _require(self.critic_history >= 1, "observation.critic_history must be at least 1")


@dataclass
class EngineConfig:
    """The physics engine and its solver."""

    name: str  # auto, native, mjwarp
    physics_dt: float  # s
    solver_iterations: int
    line_search_iterations: int
    cone: str  # pyramidal, elliptic
    threads: int  # native: 0 is all cores
    contacts_per_world: int  # mjwarp: room for contacts
    constraints_per_world: int  # mjwarp: room for constraint rows
    paddle_reaction: bool  # the ball's impulse acts on the paddle over the next control step
    ball_dt: float  # s, longest sub-step of the ball's flight
    graph: str = "auto"  # of CUDA for steps and resets on a GPU, of Warp for mjwarp on a CPU: auto, always, never

    def __post_init__(self) -> None:
        _require(self.name in ("auto", "native", "mjwarp"), f"engine must be auto, native or mjwarp, not {self.name!r}")
        _require(self.physics_dt > 0, "engine.physics_dt must be positive")
        _require(
            self.graph in ("auto", "always", "never"), f"engine.graph must be auto, always or never, not {self.graph!r}"
        )
        _require(self.cone in ("pyramidal", "elliptic"), "engine.cone must be pyramidal or elliptic")
        _require(self.threads >= 0, "engine.threads must be 0 (all cores) or more")
        for name in ("solver_iterations", "line_search_iterations", "contacts_per_world", "constraints_per_world"):
            _require(getattr(self, name) >= 1, f"engine.{name} must be at least 1")


@dataclass
class SchedulePoint:
    """A value from ``samples`` control steps on; between points it is interpolated linearly."""

    samples: float
    value: float


@dataclass
class AlgoConfig:
    """Asymmetric PPO."""

    name: str
    steps: int  # control steps a world plays per update
    epochs: int
    minibatches: int
    actor_hidden: list[int]
    critic_hidden: list[int]
    gamma: float
    gae_lambda: float
    clip: float
    value_coefficient: float
    clip_value: bool
    entropy: list[SchedulePoint]
    std: list[SchedulePoint]  # upper limit of the policy's standard deviation; the first value is the initial one
    std_floor: float
    learning_rate: float
    learning_rate_min: float
    learning_rate_max: float
    kl_target: list[SchedulePoint]  # mean KL divergence of an update that the learning rate is adapted to
    max_grad_norm: float
    observation_clip: float
    last_layer_gain: float
    autocast: str  # auto (bf16 where the hardware has it, down to fp32_below), bf16, fp32
    later_steps: list[SchedulePoint] = field(default_factory=list)  # in place of steps from that many control steps on
    fp32_below: float = 0.0  # mean std of the policy below which autocast=auto computes in float32
    observation_norm: bool = True  # by their running mean and spread; off: observations in their own units, clipped

    def steps_at(self, samples: float) -> int:
        """Control steps a world plays per update, ``samples`` control steps into the run."""
        due = [point for point in self.later_steps if point.samples <= samples]
        return int(max(due, key=lambda point: point.samples).value) if due else self.steps

    def __post_init__(self) -> None:
        for point in self.later_steps:
            whole = point.value >= 1 and point.value == int(point.value)
            _require(whole, f"algo.later_steps: {point.value} is no number of steps")
        _require(self.autocast in ("auto", "bf16", "fp32"), "algo.autocast must be auto, bf16 or fp32")
        _require(self.fp32_below >= 0, "algo.fp32_below is a standard deviation: it cannot be negative")
        for name in ("gamma", "gae_lambda"):
            _require(0 < getattr(self, name) <= 1, f"algo.{name} must lie in (0, 1]")
        lowest, first, highest = self.learning_rate_min, self.learning_rate, self.learning_rate_max
        in_order = 0 < lowest <= first <= highest
        _require(in_order, "algo needs 0 < learning_rate_min <= learning_rate <= learning_rate_max")
        for name in ("clip", "max_grad_norm", "observation_clip"):
            _require(getattr(self, name) > 0, f"algo.{name} must be positive")
        for name in ("actor_hidden", "critic_hidden"):
            _require(min(getattr(self, name), default=1) >= 1, f"algo.{name}: a layer has at least 1 unit")
        for name in ("steps", "epochs", "minibatches"):
            _require(getattr(self, name) >= 1, f"algo.{name} must be at least 1")
        for name in ("entropy", "std", "kl_target"):
            _require(len(getattr(self, name)) >= 1, f"algo.{name} needs at least one point")
        for name in ("std", "kl_target"):
            _require(all(point.value > 0 for point in getattr(self, name)), f"algo.{name} must be positive")


COUNTED_FRAMES = 5  # the last positions that ``predictor.features=counted`` sees
FRAME_DT = 0.02  # s, between the positions that ``predictor.features=flight`` fits


@dataclass
class PredictorConfig:
    """The learned predictor of the ball's apex and its online regression."""

    name: str
    frames: int  # past ball positions it sees
    hidden: list[int]
    learning_rate: float
    batch_size: int
    batches_per_update: int
    train_updates: int  # frozen afterwards; 0 trains it to the end
    outputs: list[str]  # of apex (3), target (3), target_time (1)
    enabled: bool  # off: the actor sees zeros instead (ablation)
    features: str = "steps"  # steps (positions alone), counted (the last five, and how many there were before them), or
    # flight (a fit of the whole flight); the latter two need many frames

    def __post_init__(self) -> None:
        known = ("steps", "counted", "flight")
        _require(self.features in known, f"predictor.features must be steps, counted or flight, not {self.features!r}")
        enough = self.features != "counted" or self.frames > COUNTED_FRAMES
        _require(enough, f"predictor.features=counted needs more than {COUNTED_FRAMES} frames, got {self.frames}")
        _require(self.learning_rate > 0, "predictor.learning_rate must be positive")
        for name in ("batch_size", "batches_per_update"):
            _require(getattr(self, name) >= 1, f"predictor.{name} must be at least 1, got {getattr(self, name)}")
        _require(min(self.hidden, default=1) >= 1, "predictor.hidden: a layer has at least 1 unit")


@dataclass
class SimConfig:
    """What the physics worlds need: a part of every command's configuration."""

    robot: RobotConfig
    ball: BallConfig
    engine: EngineConfig
    randomization: RandomizationConfig

    @property
    def substeps(self) -> int:
        """Physics steps of one control step."""
        count = round(self.robot.control_dt / self.engine.physics_dt)
        _require(
            count >= 1 and abs(count * self.engine.physics_dt - self.robot.control_dt) < 1e-9,
            f"engine.physics_dt {self.engine.physics_dt} must divide robot.control_dt {self.robot.control_dt}",
        )
        return count


@dataclass
class TaskConfig(SimConfig):
    """The table-tennis task: the worlds, and what is asked, sensed and rewarded in them."""

    serve: ServeConfig
    reset: ResetConfig
    reward: RewardConfig
    sensing: SensingConfig
    observation: ObservationConfig
    predictor: PredictorConfig


@dataclass
class Stage:
    """Changes of the task from ``samples`` control steps of a run on: overrides as ``sensing=wide``."""

    samples: float
    task: list[str]


@dataclass
class TrainConfig(TaskConfig):
    """``python -m pace.rl.train``: the task, the learner and the run."""

    algo: AlgoConfig
    name: str
    num_worlds: int  # in all processes together
    processes: int  # 0: one a core with 256 worlds or more each on a CPU, one on a GPU
    device: str  # auto, cpu, cuda, cuda:1
    seed: int
    samples: float  # control steps in all; whichever of samples and minutes ends first
    minutes: float  # wall-clock; 0: no limit
    run_dir: str | None  # null: runs/<date>_<name>
    resume: str | None  # a run folder or checkpoint to go on from
    init_from: str | None  # a run folder or checkpoint whose weights to start from
    checkpoint_minutes: float
    tensorboard: bool
    progress: bool
    # a run folder or checkpoint whose predictor to start from, instead of that of init_from
    predictor_from: str | None = field(default=None, kw_only=True)
    curriculum: list[Stage] = field(default_factory=list, kw_only=True)  # each changes the task of the one before

    def __post_init__(self) -> None:
        _require(self.num_worlds >= 1, f"num_worlds must be at least 1, got {self.num_worlds}")
        _require(self.processes >= 0, f"processes must be 0 (chosen for the machine) or more, got {self.processes}")
        _require(
            self.processes == 0 or self.num_worlds % self.processes == 0,
            f"num_worlds {self.num_worlds} cannot be shared equally by {self.processes} processes",
        )
        fits = self.predictor.features != "flight" or math.isclose(self.robot.control_dt, FRAME_DT)
        _require(fits, f"predictor.features=flight needs robot.control_dt {FRAME_DT} s, got {self.robot.control_dt}")
        _require(self.samples > 0, "samples must be positive")
        _require(self.minutes >= 0, f"minutes must not be negative (0: no limit), got {self.minutes}")
        _require(not (self.resume and self.init_from), "give resume or init_from, not both")
        _require(not (self.resume and self.predictor_from), "give resume or predictor_from, not both")
        begins = [stage.samples for stage in self.curriculum]
        _require(begins == sorted(set(begins)), f"curriculum: the stages must begin one after another, got {begins}")
        _require(all(begin > 0 for begin in begins), "curriculum: a stage at 0 is the task itself; change that")


@dataclass
class BenchOptions:
    """What ``python -m pace.bench`` measures, and how long."""

    parts: list[str]  # of physics, mjwarp, update, train, memory
    repeats: int
    settle_steps: int  # control steps
    control_steps: int
    mjwarp_steps: int  # control steps
    action_std: float
    update_worlds: int
    policy_size: int
    critic_size: int
    train_updates: int
    memory_updates: int

    def __post_init__(self) -> None:
        known = ("physics", "mjwarp", "update", "train", "memory")
        for part in self.parts:
            _require(part in known, f"bench.parts: {part!r} is not one of {', '.join(known)}")
        for name, value in vars(self).items():
            if isinstance(value, int):
                _require(value >= 1, f"bench.{name} must be at least 1, got {value}")


@dataclass
class BenchConfig(TrainConfig):
    """``python -m pace.bench``: what is trained, and how it is measured."""

    bench: BenchOptions


@dataclass
class PaperRow:
    """A row of the paper's table II."""

    serves: int
    hit: float  # share of the serves
    success: float  # share of the serves


@dataclass
class VariationConfig:
    """Values of each change of ``python -m pace.rl.evaluate --sweep``, one change at a time."""

    ball: list[str]  # presets; []: all of configs/ball/
    engine: list[str]
    noise: list[float]  # times the sensing noise
    latency: list[float]  # s added to the delay of motion capture
    friction: list[float]  # added to the friction of the robot's bodies
    trunk_mass: list[float]  # kg added
    gain: list[float]  # times kp and kd

    def __post_init__(self) -> None:
        for name in ("noise", "latency", "gain"):
            _require(min(getattr(self, name), default=0.0) >= 0, f"variations.{name} must not be negative")


@dataclass
class EvaluateConfig:
    """``python -m pace.rl.evaluate``: which policy, on what task, how many serves."""

    run: str | None
    policy: str  # run, zero, random
    rows: list[str]  # names of configs/serve/
    serves: int  # at least so many a row
    warmup_serves: int  # first serves of each world, not counted
    num_worlds: int
    device: str
    seed: int
    physics_dt: float  # s
    overrides: list[str]  # of the saved task
    out: str | None
    progress: bool
    sweep: bool
    sweep_serves: int  # at least so many a row of a cell
    sweep_serves_slow: int  # the same for mjwarp on a CPU
    sweep_rows: list[str]
    variations: VariationConfig
    paper: dict[str, PaperRow]

    def __post_init__(self) -> None:
        _require(self.policy in ("run", "zero", "random"), f"policy must be run, zero or random, not {self.policy!r}")
        _require(self.policy != "run" or self.run is not None, "which run? give its folder, or policy=zero|random")
        _require(len(self.rows) > 0 or self.sweep, "rows must name at least one serve range")
        _require(len(self.sweep_rows) > 0 or not self.sweep, "sweep_rows must name at least one serve range")
        for name in ("serves", "sweep_serves", "sweep_serves_slow", "num_worlds"):
            _require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
        _require(self.warmup_serves >= 0, f"warmup_serves must not be negative, got {self.warmup_serves}")


@dataclass
class ExportConfig:
    """``python -m pace.rl.export``: which policy, where to, and how it is checked."""

    run: str | None
    out: str
    check_worlds: int
    check_steps: int
    tolerance: float  # rad, m, s
    seed: int

    def __post_init__(self) -> None:
        _require(self.run is not None, "which run? give its folder, a checkpoint or pretrained/<name>")
        for name in ("check_worlds", "check_steps"):
            _require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")


@dataclass
class PlayConfig:
    """``python -m pace.rl.play``: which policy, where it is shown, or what is filmed."""

    run: str | None
    host: str
    port: int
    speed: float  # of time; 1: real time
    seed: int
    physics_dt: float  # s
    overrides: list[str]  # of the saved task
    video: str | None
    seconds: float  # of play
    width: int  # pixels of each view
    height: int
    fps: int

    def __post_init__(self) -> None:
        _require(self.run is not None, "which run? give its folder, a checkpoint or pretrained/<name>")
        _require(0 < self.speed <= 1, f"speed must lie in (0, 1], got {self.speed}")
        _require(1 <= self.port <= 65535, f"port must lie in 1 to 65535, got {self.port}")
        _require(self.video is None or self.video.endswith(".mp4"), f"video must end in .mp4, got {self.video}")
        for name in ("seconds", "fps"):
            _require(getattr(self, name) > 0, f"{name} must be positive, got {getattr(self, name)}")
        for name in ("width", "height"):
            value = getattr(self, name)
            _require(value > 0 and value % 2 == 0, f"{name} must be an even number of pixels, got {value}")


@dataclass
class AblateConfig:
    """``python -m pace.rl.ablate``: which experiments, with which seeds, and how long."""

    experiments: list[str]  # names of configs/experiment/
    seeds: list[int]
    samples: float  # control steps of each run
    jobs: int  # runs at a time
    window: float  # control steps that a point of a curve averages over
    run_dir: str
    out: str | None  # null: run_dir
    figure: str  # its name in out
    train: bool
    overrides: list[str]  # of the training
    progress: bool

    def __post_init__(self) -> None:
        for name in ("experiments", "seeds"):
            values = getattr(self, name)
            _require(len(values) > 0, f"{name} must name at least one")
            _require(len(set(values)) == len(values), f"{name} names one twice: {values}")
        for name in ("samples", "window"):
            _require(getattr(self, name) > 0, f"{name} must be positive, got {getattr(self, name)}")
        _require(self.jobs >= 1, f"jobs must be at least 1, got {self.jobs}")
        _require(self.figure.endswith(".png"), f"figure must end in .png, got {self.figure}")


def parse(config: DictConfig | dict[str, Any], schema: type[T]) -> T:
    """Check ``config`` against a dataclass and return an instance of it.

    Errors: :class:`ConfigError` that names the key, for an unknown or missing key, a wrong type or a bad value.
    """
    plain = config if isinstance(config, DictConfig) else OmegaConf.create(config)
    try:
        OmegaConf.resolve(plain)
        merged = OmegaConf.merge(OmegaConf.structured(schema), plain)
        return OmegaConf.to_object(merged)  # type: ignore[return-value]
    except OmegaConfBaseException as error:
        key = getattr(error, "full_key", None) or "?"
        reason = str(error).split("\n")[0]
        raise ConfigError(f"configuration key '{key}': {reason}") from error


def compose(config_name: str, overrides: list[str] | None = None) -> DictConfig:
    """Compose ``configs/<config_name>.yaml`` with Hydra overrides, for tests, notebooks and rebuilt runs."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    outer = GlobalHydra.instance().hydra  # set while a command runs, which may compose other configurations
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(config_dir=str(config_dir()), version_base="1.3"):
            return hydra_compose(config_name=config_name, overrides=overrides or [])
    finally:
        GlobalHydra.instance().hydra = outer


def load_train_config(overrides: list[str] | None = None) -> TrainConfig:
    """The training configuration of ``configs/train.yaml`` with Hydra overrides such as ``["num_worlds=64"]``."""
    return parse(compose("train", overrides), TrainConfig)


def to_dict(config: Any) -> dict[str, Any]:
    """A dataclass of this module as plain nested dictionaries, ready for YAML or JSON."""
    if not is_dataclass(config):
        raise ConfigError(f"not a configuration: {type(config).__name__}")
    return OmegaConf.to_container(OmegaConf.structured(config))  # type: ignore[return-value]
