"""Configuration of the physics worlds: robot, engine, randomization, sensing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

from pace.config import plugins
from pace.config.ball import BallConfig
from pace.config.base import Range, check_range, require

LEAST_SPEED = 1e-3  # rad/s, of a motor with a torque-speed line: with less its resistance is no number


@dataclass
class JointGroup:
    """Gains, limits, inertia and friction of the joints whose name contains one of ``match``."""

    match: list[str]
    kp: float  # N m / rad
    kd: float  # N m s / rad
    effort: float  # N m
    max_speed: float = 0.0  # rad/s, at which the motor has no torque; needed if robot.stall_ratio is on
    armature: float | None = None  # kg m^2; None: robot.armature
    friction: float = 0.0  # N m, dry

    def __post_init__(self) -> None:
        for name in ("armature", "friction"):
            value = getattr(self, name)
            known = value is None or 0 <= value < math.inf
            require(known, f"robot.joint_groups {self.match}: {name} must be finite and not negative, got {value}")


@dataclass
class RobotConfig:
    """The robot: its MJCF and the parts of it by name, control rate, gains, nominal pose."""

    name: str
    model: str  # MJCF: a file of pace/sim/assets, or a path
    paddle_site: str  # site at the centre of the blade; its link's x axis is the normal of the face
    foot_sites: list[str]  # sites at the centres of the left and the right sole
    head_site: str
    arm: list[str]  # parts of the names of the joints between trunk and paddle, past the waist
    groups: dict[str, list[str]]  # parts of the names of the joints that reward terms sum over, by group
    control_dt: float  # s
    action_scale: float  # rad per unit of action
    action_clip: float  # largest |action|
    armature: float  # kg m^2, of joints whose group has none
    base_height: float  # m, base above the floor at reset
    joint_groups: list[JointGroup]  # the first match of a joint counts
    nominal_pose: dict[str, float]  # rad; joints not named are at 0
    stall_ratio: float = 0.0  # stall torque over effort; 0: full effort at any speed (earlier policies)
    # pairs of geoms that touch each other, besides those that the MJCF lists; a robot that has some counts as contacts
    # of a body those with floor and table alone
    self_collision: list[list[str]] = field(default_factory=list)
    reset_limits: dict[str, Range] = field(default_factory=dict)  # rad, within which a joint starts, besides its range
    # bodies or geoms of the hand that holds the paddle, below the wrist: the ball may touch them as it may the paddle
    paddle_hand: list[str] = field(default_factory=list)
    free_hand: str = ""  # body of the hand without the paddle, which must not touch the playing surface; "": none

    def __post_init__(self) -> None:
        for pair in self.self_collision:
            require(len(set(pair)) == len(pair) == 2, f"robot.self_collision needs pairs of two geoms, got {pair}")
        for joint, limits in self.reset_limits.items():
            check_range(f"robot.reset_limits.{joint}", limits)
        require(self.control_dt > 0, "robot.control_dt must be positive")
        require(len(self.foot_sites) == 2, f"robot.foot_sites must name a left and a right sole, got {self.foot_sites}")
        known = self.stall_ratio == 0 or 1 <= self.stall_ratio < math.inf
        require(known, f"robot.stall_ratio must be 0 (no limit) or a number from 1 on, got {self.stall_ratio}")
        slow = [group.match for group in self.joint_groups if group.max_speed < LEAST_SPEED]
        require(not (self.stall_ratio and slow), f"robot.stall_ratio needs the max_speed of the joint groups {slow}")
        require(self.action_clip > 0, "robot.action_clip must be positive")


@dataclass
class RandomizationConfig:
    """Ranges of each world's parameters, sampled at each reset. ``[1, 1]`` and ``[0, 0]``: no randomisation."""

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
    lift_scale: Range = field(default_factory=lambda: [1.0, 1.0])  # of ball.table_lift
    table_tangential_restitution: Range = field(default_factory=lambda: [0.0, 0.0])  # added
    paddle_tangential_restitution: Range = field(default_factory=lambda: [0.0, 0.0])  # added
    paddle_drilling_loss: Range = field(default_factory=lambda: [0.0, 0.0])  # added
    backlash: Range = field(default_factory=lambda: [0.0, 0.0])  # rad, play of every joint's gear
    paddle_tilt: Range = field(default_factory=lambda: [0.0, 0.0])  # rad, of the face, in a random direction
    paddle_shift: Range = field(default_factory=lambda: [0.0, 0.0])  # m, of its centre, in a random direction
    speed_scale: Range = field(default_factory=lambda: [1.0, 1.0])  # of max_speed; of no effect without stall_ratio
    ankle_effort_scale: Range = field(default_factory=lambda: [1.0, 1.0])  # times effort_scale, of the group ankles
    joint_friction: Range = field(default_factory=lambda: [0.0, 0.0])  # N m, dry, added in every joint
    joint_damping: Range = field(default_factory=lambda: [0.0, 0.0])  # N m s/rad, added in every joint
    preset_share: float = 0.0  # probability that a world's ball, air and contacts are those of ball=

    def __post_init__(self) -> None:
        for f in fields(self):
            if f.name not in ("name", "preset_share"):
                check_range(f"randomization.{f.name}", getattr(self, f.name))
        for name in ("actuator_delay", "backlash", "paddle_tilt", "paddle_shift"):
            check_range(f"randomization.{name}", getattr(self, name), lowest=0.0)
        for name in ("effort_scale", "speed_scale", "ankle_effort_scale"):
            require(getattr(self, name)[0] > 0, f"randomization.{name} must be positive")
        for name in ("joint_friction", "joint_damping"):
            require(getattr(self, name)[0] >= 0, f"randomization.{name} must not be negative")
        require(0.0 <= self.preset_share <= 1.0, "randomization.preset_share must lie within 0 and 1")


@dataclass
class MocapConfig:
    """Frames of a motion-capture system. The defaults are one a control step, as old as ``mocap_delay``."""

    rate: float = 0.0  # Hz, of frames that come by themselves; 0: one a control step
    white_noise: float = 0.0  # m, standard deviation of each axis of base and ball, independent in each frame
    slow_noise: float = 0.0  # m, standard deviation of each axis of base and ball, first-order autoregressive
    slow_noise_time: float = 0.06  # s, its time constant
    lost: float = 0.0  # probability that a frame is lost
    gap_rate: float = 0.0  # 1/s, runs of lost frames that begin while there is none
    gap: Range = field(default_factory=lambda: [0.0, 0.0])  # s, length of a run
    jitter: Range = field(default_factory=lambda: [0.0, 0.0])  # s, delay of each frame besides sensing.mocap_delay
    occlusion: float = 0.0  # m; a ball nearer than this to the centre of the paddle is hidden; 0: off

    def __post_init__(self) -> None:
        for name in ("rate", "white_noise", "slow_noise", "gap_rate", "occlusion"):
            value = getattr(self, name)
            require(0.0 <= value < math.inf, f"sensing.mocap.{name} must be finite and not negative, got {value}")
        require(0.0 < self.slow_noise_time < math.inf, "sensing.mocap.slow_noise_time must be positive and finite")
        require(0.0 <= self.lost <= 1.0, f"sensing.mocap.lost must lie within 0 and 1, got {self.lost}")
        for name in ("gap", "jitter"):
            value = getattr(self, name)
            check_range(f"sensing.mocap.{name}", value, lowest=0.0)
            require(value[1] < math.inf, f"sensing.mocap.{name} must be finite, got {value}")
        for name in ("gap_rate", "occlusion"):
            require(self.rate > 0.0 or getattr(self, name) == 0.0, f"sensing.mocap.{name} needs sensing.mocap.rate")


@dataclass
class SensingConfig:
    """Errors of the robot's sensors: uniform noise (+- amplitude), delay, and the frames of motion capture."""

    name: str
    base_angular_velocity: float  # rad/s
    base_position: float  # m
    projected_gravity: float
    joint_position: float  # rad
    joint_velocity: float  # rad/s
    ball_position: float  # m
    heading: float
    base_shift: float  # m
    mocap_delay: Range  # s, sampled per world at reset: ball, base position and heading
    noise_scale: Range = field(default_factory=lambda: [1.0, 1.0])  # of all amplitudes, sampled per world at reset
    # m; the ball counts as returned once it is sensed this much farther away than two control steps earlier; noise
    # alone stays below the threshold
    moved: float = 0.03
    # m/s; a ball sensed farther from its last position than this allows is another ball (smashes: below 20 m/s)
    fastest_ball: float = 25.0
    # s; a ball without a frame is extrapolated for so long, and one that is seen again after it counts as another
    longest_gap: float = 0.1
    mocap: MocapConfig = field(default_factory=MocapConfig)

    def __post_init__(self) -> None:
        check_range("sensing.mocap_delay", self.mocap_delay, lowest=0.0)
        check_range("sensing.noise_scale", self.noise_scale, lowest=0.0)
        require(self.moved >= 0, f"sensing.moved must not be negative, got {self.moved}")
        require(self.fastest_ball > 0, f"sensing.fastest_ball must be positive, got {self.fastest_ball}")
        require(self.longest_gap >= 0, f"sensing.longest_gap must not be negative, got {self.longest_gap}")


@dataclass
class EngineConfig:
    """The physics engine and its solver."""

    name: str  # auto, native, mjwarp, or a class from outside: my_module:MyEngine
    physics_dt: float  # s
    solver_iterations: int
    line_search_iterations: int
    cone: str  # pyramidal, elliptic
    threads: int  # native: 0 is all cores
    contacts_per_world: int  # mjwarp: memory for contacts
    constraints_per_world: int  # mjwarp: memory for constraint rows
    paddle_reaction: bool  # the ball's impulse acts on the paddle over the next control step
    ball_dt: float  # s, longest sub-step of the ball's flight
    largest_speed: float = field(default=0.0, kw_only=True)  # m/s, rad/s; a faster robot has diverged; 0: no limit
    remembered_steps: int = field(default=0, kw_only=True)  # control steps that a replay of a fault goes back; 0: none
    # of CUDA for steps and updates on a GPU, of Warp for mjwarp on a CPU: auto, always, never; or dry, which goes a
    # GPU's way on a CPU and names what a graph could not hold
    graph: str = "auto"
    # mjwarp on a GPU: contacts, constraints and sums in a fixed order (MuJoCo Warp's own switch), for a price
    deterministic: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        known = self.name in ("auto", "native", "mjwarp") or plugins.may_be_outside(plugins.ENGINES, self.name)
        wanted = "auto, native or mjwarp, or come from a module named in plugins=[...]"
        require(known, f"engine must be {wanted}, not {self.name!r}")
        require(self.physics_dt > 0, "engine.physics_dt must be positive")
        known = self.graph in ("auto", "always", "never", "dry")
        require(known, f"engine.graph must be auto, always, never or dry, not {self.graph!r}")
        require(self.cone in ("pyramidal", "elliptic"), "engine.cone must be pyramidal or elliptic")
        require(self.threads >= 0, "engine.threads must be 0 (all cores) or more")
        for name in ("solver_iterations", "line_search_iterations", "contacts_per_world", "constraints_per_world"):
            require(getattr(self, name) >= 1, f"engine.{name} must be at least 1")


@dataclass
class SimConfig:
    """Configuration of the physics worlds: a part of every command's configuration."""

    robot: RobotConfig
    ball: BallConfig
    engine: EngineConfig
    randomization: RandomizationConfig

    @property
    def substeps(self) -> int:
        """Physics steps of one control step."""
        count = round(self.robot.control_dt / self.engine.physics_dt)
        require(
            count >= 1 and abs(count * self.engine.physics_dt - self.robot.control_dt) < 1e-9,
            f"engine.physics_dt {self.engine.physics_dt} must divide robot.control_dt {self.robot.control_dt}",
        )
        return count
