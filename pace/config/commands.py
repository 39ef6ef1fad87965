"""The other commands: bench, evaluate, export, retrace, ablate, compare, keep, validate, studies."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from pace.config.base import require
from pace.config.quality import QualityConfig, check_first_ball
from pace.config.training import TrainConfig


@dataclass
class BenchOptions:
    """Parts and duration of the measurements of ``python -m pace.bench``."""

    parts: list[str]  # of physics, mjwarp, update, train, neighbours, memory
    repeats: int
    settle_steps: int  # control steps
    control_steps: int
    mjwarp_steps: int  # control steps
    action_std: float
    update_worlds: int
    policy_size: int
    critic_size: int
    action_size: int
    train_updates: int
    memory_updates: int

    def __post_init__(self) -> None:
        known = ("physics", "mjwarp", "update", "train", "neighbours", "memory")
        for part in self.parts:
            require(part in known, f"bench.parts: {part!r} is not one of {', '.join(known)}")
        for name, value in vars(self).items():
            if isinstance(value, int):
                require(value >= 1, f"bench.{name} must be at least 1, got {value}")


@dataclass
class BenchConfig(TrainConfig):
    """``python -m pace.bench``: the training task, and the measurements."""

    bench: BenchOptions


@dataclass
class WarmConfig(TrainConfig):
    """``python -m pace.rl.warm``: the training whose kernels to compile, and for what."""

    arch: str | None  # sm_90; None: for the device


@dataclass
class PaperRow:
    """A row of the paper's table II."""

    serves: int
    hit: float  # share of the serves
    success: float  # share of the serves


@dataclass
class VariationConfig:
    """Values of each change of ``python -m pace.evaluation --sweep``, one change at a time."""

    ball: list[str]  # presets; []: all of configs/ball/
    engine: list[str]
    noise: list[float]  # times the sensing noise
    latency: list[float]  # s added to the delay of motion capture
    friction: list[float]  # added to the friction of the robot's bodies
    trunk_mass: list[float]  # kg added
    gain: list[float]  # times kp and kd

    def __post_init__(self) -> None:
        for name in ("noise", "latency", "gain"):
            require(min(getattr(self, name), default=0.0) >= 0, f"variations.{name} must not be negative")


@dataclass
class EvaluateConfig:
    """``python -m pace.evaluation``: the policy, its task, and the number of serves."""

    run: str | None
    policy: str  # run, zero, random
    task: str  # table, own
    rows: list[str]  # names of configs/serve/
    serves: int  # least number of serves per row
    warmup_serves: int  # first serves of each world, not counted
    balls_per_world: int  # counted
    num_worlds: int | None  # None: as many as balls_per_world asks for
    device: str
    seed: int
    physics_dt: float  # s
    overrides: list[str]  # of the task
    out: str | None
    progress: bool
    sweep: bool
    sweep_serves: int  # least number of serves per row of a cell
    sweep_serves_slow: int  # the same for mjwarp on a CPU
    sweep_rows: list[str]
    variations: VariationConfig
    reality: str | None  # a file of configs/realities/
    first_ball: list[float]  # s that robots stand ready before their first ball
    first_ball_worlds: int  # robots for each of these times
    first_ball_serve: str  # a name of configs/serve/
    first_ball_kind: str  # what the ball does until then: a key of serve.pause_ball
    quality: QualityConfig
    paper: dict[str, PaperRow]
    plugins: list[str] = field(default_factory=list)  # modules that add what the saved task needs

    def __post_init__(self) -> None:
        require(self.policy in ("run", "zero", "random"), f"policy must be run, zero or random, not {self.policy!r}")
        require(self.policy != "run" or self.run is not None, "which run? give its folder, or policy=zero|random")
        require(len(self.rows) > 0 or self.sweep, "rows must name at least one serve range")
        require(len(self.sweep_rows) > 0 or not self.sweep, "sweep_rows must name at least one serve range")
        require(self.task in ("table", "own"), f"task must be table or own, not {self.task!r}")
        for name in ("serves", "sweep_serves", "sweep_serves_slow", "balls_per_world"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
        given = self.num_worlds is None or self.num_worlds >= 1
        require(given, f"num_worlds must be null or at least 1, got {self.num_worlds}")
        require(self.warmup_serves >= 0, f"warmup_serves must not be negative, got {self.warmup_serves}")
        check_first_ball(self.first_ball, self.first_ball_worlds, self.first_ball_kind)

    def worlds_for(self, serves: int) -> int:
        """Worlds that play a row of ``serves``."""
        worlds = math.ceil(serves / self.balls_per_world) if self.num_worlds is None else self.num_worlds
        return min(worlds, serves)


@dataclass
class ExportConfig:
    """``python -m pace.deploy``: the policy, the folder, and the check of the export."""

    run: str | None
    out: str | None  # folder; null: runs/<date>_export
    check_worlds: int
    check_steps: int
    tolerance: float  # rad, m, s
    seed: int
    plugins: list[str] = field(default_factory=list)  # modules that add what the saved task needs

    def __post_init__(self) -> None:
        require(self.run is not None, "which run? give its folder, a checkpoint or pretrained/<name>")
        for name in ("check_worlds", "check_steps"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")


@dataclass
class RetraceConfig:
    """``python -m pace.deploy.retrace``: the exported policy, the log, and what counts as a difference."""

    policy: str | None
    log: str | None
    tolerance: float  # rad
    late: float  # share of control_dt
    out: str | None

    def __post_init__(self) -> None:
        require(self.policy is not None, "which policy? give policy.onnx of pace export, then the log")
        require(self.log is not None, "which log? give the file that the robot has recorded, after policy.onnx")
        for name in ("tolerance", "late"):
            require(getattr(self, name) > 0, f"{name} must be positive, got {getattr(self, name)}")


@dataclass
class AblateConfig:
    """``python -m pace.studies.ablate``: the experiments, their seeds, and their length."""

    experiments: list[str]  # names of configs/experiment/
    seeds: list[int]
    samples: float  # control steps of each run
    jobs: int  # runs at a time
    window: float  # control steps that a point of a curve averages over
    out: str  # folder of the runs, of a slim CSV each, and of the figure
    figure: str  # its name in out
    train: bool
    overrides: list[str]  # of the training
    progress: bool

    def __post_init__(self) -> None:
        for name in ("experiments", "seeds"):
            values = getattr(self, name)
            require(len(values) > 0, f"{name} must name at least one")
            require(len(set(values)) == len(values), f"{name} names one twice: {values}")
        for name in ("samples", "window"):
            require(getattr(self, name) > 0, f"{name} must be positive, got {getattr(self, name)}")
        require(self.jobs >= 1, f"jobs must be at least 1, got {self.jobs}")
        require(self.figure.endswith(".png"), f"figure must end in .png, got {self.figure}")


@dataclass
class CompareConfig:
    """``python -m pace.studies.compare``: the runs, and the serves that two policies play."""

    runs: list[str]
    figure: str  # its name in out
    window: float  # control steps that a point of a curve averages over
    play: bool
    task: str  # table, own
    rows: list[str]  # names of configs/serve/
    serves: int  # least number of serves per row
    warmup_serves: int  # first serves of each world, not counted
    balls_per_world: int  # counted
    num_worlds: int | None  # None: as many as balls_per_world asks for
    device: str
    seed: int
    physics_dt: float  # s
    overrides: list[str]  # of the task
    out: str | None
    progress: bool
    plugins: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        require(len(self.runs) > 0, "which runs? give run folders, checkpoints, pretrained/<name> or CSVs")
        for run in self.runs:
            require(self.runs.count(run) == 1, f"{run} is given twice")
        require(self.figure.endswith(".png"), f"figure must end in .png, got {self.figure}")
        require(len(self.rows) > 0, "rows must name at least one serve range; play=false plays none")
        require(self.task in ("table", "own"), f"task must be table or own, not {self.task!r}")

    @property
    def worlds(self) -> int:
        """Worlds that play a row."""
        worlds = math.ceil(self.serves / self.balls_per_world) if self.num_worlds is None else self.num_worlds
        return min(worlds, self.serves)


@dataclass
class KeepConfig:
    """``python -m pace.evaluation.keep``: the run to publish, and the folder."""

    run: str | None
    out: str | None
    evaluation: str | None  # folder that pace evaluate wrote
    notes: str | None  # Markdown file
    training: bool  # whether the folder can be resumed

    def __post_init__(self) -> None:
        require(self.run is not None, "which run? give its folder or a checkpoint, and the folder to write")
        require(self.out is not None, "where to? give the folder of the policy, such as pretrained/mine")


@dataclass
class ValidateConfig:
    """``python -m pace.studies.ball``: the folder of its figures."""

    out: str | None


@dataclass
class StudiesConfig:
    """``python -m pace.studies``: the measurements, their subject, and their size."""

    studies: list[str]  # names, or all
    worlds: int
    serves: int
    hours: float  # of play
    run: str | None
    cases: list[str]
    predictors: list[str]
    out: str | None
    plugins: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in ("worlds", "serves"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
