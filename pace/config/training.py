"""The learner and the run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from omegaconf import DictConfig

from pace.config import automatic, plugins
from pace.config.base import Completed, compose, parse, require
from pace.config.judge import JudgeConfig
from pace.config.names import check_renamed
from pace.config.predictor import FRAME_DT
from pace.config.schedules import Position, SchedulePoint, Stage, check_begins, in_shares
from pace.config.task import TaskConfig


@dataclass
class AlgoConfig:
    """The learning algorithm: asymmetric PPO; an algorithm from outside uses those of these numbers that it needs."""

    name: str
    steps: int  # control steps of a world per update
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
    # mixed (bf16; the actor in fp32 from a std of fp32_below on), bf16, fp32; auto: by the device
    autocast: str
    later_steps: list[SchedulePoint] = field(default_factory=list)  # in place of steps, from a place in the run on
    fp32_below: float = 0.0  # mean std of the policy below which with autocast=mixed the actor is float32
    algorithm: str = "ppo"  # or a class from outside: my_module:MyAlgorithm
    params: dict[str, float] = field(default_factory=dict)  # numbers of an algorithm from outside
    skips: int = 0  # updates in a row that are skipped because they are not finite, before the run stops
    observation_norm: bool = True  # by running mean and std; off: observations in their own units, clipped

    @property
    def schedules(self) -> dict[str, list[SchedulePoint]]:
        """All schedules by their keys."""
        return {name: getattr(self, name) for name in ("entropy", "std", "kl_target", "later_steps")}

    def steps_at(self, at: Position) -> int:
        """Control steps of a world per update, at a place in the run."""
        due = [point for point in self.later_steps if point.reached(at)]
        return int(max(due, key=lambda point: point.place).value) if due else self.steps

    def __post_init__(self) -> None:
        known = self.algorithm == "ppo" or plugins.may_be_outside(plugins.ALGORITHMS, self.algorithm)
        wanted = "ppo, or come from a module named in plugins=[...]"
        require(known, f"algo.algorithm must be {wanted}, not {self.algorithm!r}")
        for name, points in self.schedules.items():
            check_begins(f"algo.{name}", points)
        for point in self.later_steps:
            whole = point.value >= 1 and point.value == int(point.value)
            require(whole, f"algo.later_steps: {point.value} is no number of steps")
        known = ("auto", "mixed", "bf16", "fp32")
        require(self.autocast in known, "algo.autocast must be auto, mixed, bf16 or fp32")
        require(self.fp32_below >= 0, "algo.fp32_below is a standard deviation: it cannot be negative")
        for name in ("gamma", "gae_lambda"):
            require(0 < getattr(self, name) <= 1, f"algo.{name} must lie in (0, 1]")
        lowest, first, highest = self.learning_rate_min, self.learning_rate, self.learning_rate_max
        in_order = 0 < lowest <= first <= highest
        require(in_order, "algo needs 0 < learning_rate_min <= learning_rate <= learning_rate_max")
        for name in ("clip", "max_grad_norm", "observation_clip"):
            require(getattr(self, name) > 0, f"algo.{name} must be positive")
        for name in ("actor_hidden", "critic_hidden"):
            require(min(getattr(self, name), default=1) >= 1, f"algo.{name}: a layer has at least 1 unit")
        for name in ("steps", "epochs", "minibatches"):
            require(getattr(self, name) >= 1, f"algo.{name} must be at least 1")
        for name in ("entropy", "std", "kl_target"):
            require(len(getattr(self, name)) >= 1, f"algo.{name} needs at least one point")
        for name in ("std", "kl_target"):
            require(all(point.value > 0 for point in getattr(self, name)), f"algo.{name} must be positive")


@dataclass
class PlanConfig:
    """How the number of control steps is planned that the shares of schedules are of (:class:`pace.rl.plan.Plan`)."""

    warm_up: int = 5  # updates before the speed is measured
    updates: int = 20  # over which it is measured, and
    seconds: float = 2.0  # at least
    samples: float = 84.0e6  # planned for a run without an end


@dataclass
class TrainConfig(TaskConfig, Completed):
    """``python -m pace.rl.train``: the task, the learner and the run."""

    algo: AlgoConfig
    name: str
    num_worlds: int  # in all processes together
    processes: int  # 0: one a core with 256 worlds or more each on a CPU, one on a GPU
    device: str  # auto, cpu, cuda, cuda:1
    seed: int
    samples: float  # control steps in all; whichever of samples and minutes ends first
    minutes: float  # wall-clock; 0: no limit
    out: str | None  # folder of the run; null: runs/<date>_<name>
    resume: str | None  # a run folder or checkpoint to resume
    init_from: str | None  # a run folder or checkpoint whose weights to start from
    checkpoint_minutes: float
    tensorboard: bool
    progress: bool
    # a run folder or checkpoint whose predictor to start from, instead of that of init_from
    predictor_from: str | None = field(default=None, kw_only=True)
    curriculum: list[Stage] = field(default_factory=list, kw_only=True)  # each changes the task of the one before
    plan: PlanConfig = field(default_factory=PlanConfig, kw_only=True)
    judge: JudgeConfig = field(default_factory=JudgeConfig, kw_only=True)
    plugins: list[str] = field(default_factory=list, kw_only=True)  # modules that add terms, observations, ...
    logger: str | None = field(default=None, kw_only=True)  # wandb: besides metrics.csv and TensorBoard's events

    @classmethod
    def complete(cls, plain: DictConfig) -> DictConfig:
        """Values of a CPU in place of ``auto``, if no machine was asked (:func:`pace.config.automatic.choose`)."""
        return automatic.choose(plain, automatic.CPU)[0]

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.num_worlds >= 1, f"num_worlds must be at least 1, got {self.num_worlds}")
        require(self.processes >= 0, f"processes must be 0 (chosen for the machine) or more, got {self.processes}")
        require(
            self.processes == 0 or self.num_worlds % self.processes == 0,
            f"num_worlds {self.num_worlds} cannot be shared equally by {self.processes} processes",
        )
        fits = self.predictor.features != "flight" or math.isclose(self.robot.control_dt, FRAME_DT)
        require(fits, f"predictor.features=flight needs robot.control_dt {FRAME_DT} s, got {self.robot.control_dt}")
        require(self.samples > 0, "samples must be positive")
        require(self.minutes >= 0, f"minutes must not be negative (0: no limit), got {self.minutes}")
        require(not (self.resume and self.init_from), "give resume or init_from, not both")
        require(not (self.resume and self.predictor_from), "give resume or predictor_from, not both")
        check_begins("curriculum", self.curriculum)
        begins = [stage.place for stage in self.curriculum]
        require(begins == sorted(set(begins)), f"curriculum: the stages must begin one after another, got {begins}")
        require(all(begin > 0 for begin in begins), "curriculum: a stage at 0 is the task itself; change that")

    @property
    def in_shares(self) -> bool:
        """Whether any schedule is in shares of the plan."""
        return any(in_shares(begins) for begins in (*self.algo.schedules.values(), self.curriculum))


def load_train_config(overrides: list[str] | None = None) -> TrainConfig:
    """The training configuration of ``configs/train.yaml`` with Hydra overrides such as ``["num_worlds=64"]``.

    Errors: :class:`ConfigError` for a bad value and for a renamed key or choice.
    """
    check_renamed(overrides or [])
    composed = compose("train", overrides)
    plugins.use_named(composed)
    return parse(composed, TrainConfig)


# Keys that a resumed run may change; all others are as saved, or the run would not resume exactly.
# Another number of processes means new worlds; with out=, a new run folder goes on from the checkpoint.
RESUME_KEYS = (
    "resume", "samples", "minutes", "checkpoint_minutes", "tensorboard", "logger", "progress", "device", "processes",
    "plugins", "engine.graph", "out", "judge.serves", "judge.last_serves", "judge.after", "judge.video",
)  # fmt: skip
