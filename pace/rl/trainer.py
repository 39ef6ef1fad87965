"""The training loop: roll out, check, fit the predictor, update the policy, log, save."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pace.config.base import ConfigError, to_dict
from pace.config.schedules import PLANNED
from pace.config.training import TrainConfig
from pace.distributed import ProcessGroup
from pace.predictor.network import BallPredictor
from pace.predictor.regression import PredictorTrainer
from pace.rl.agent import Sizes
from pace.rl.algorithm import ALGORITHMS
from pace.rl.curriculum import Curriculum
from pace.rl.judge import Judge
from pace.rl.plan import Plan
from pace.rl.recovery import Recovery
from pace.rl.rollout import TrainableTask
from pace.rl.update import Update
from pace.runs.checkpoint import PROCESSES, Checkpoint, CheckpointError, load_weights
from pace.runs.interrupt import StopRequest
from pace.runs.learning_curve import plot_learning_curve
from pace.runs.progress import Progress
from pace.runs.run_folder import RunFolder

LEARNER, OLD_LEARNER = "algorithm", "ppo"  # part of a checkpoint's training state, and its former name


@dataclass(frozen=True)
class Summary:
    """How a run ended: why, where its files are, and means over its last updates."""

    reason: str
    updates: int
    samples: int
    seconds: float
    checkpoint: Path
    curve: Path | None
    rates: dict[str, float]
    faults: list[str]  # in words

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return self.checkpoint.parent.parent


class Trainer:
    """Trains the agent and the predictor of ``config`` on ``env`` and writes the run's files.

    The ``algorithm`` (``config.algo.algorithm``) acts and learns. ``predictor`` is the network that ``env`` predicts
    with; it is trained in place. ``env`` holds this process's worlds. Each process of a ``group`` has a trainer and
    calls every method together with the others; only rank 0 has the ``run``. A ``curriculum`` replaces the worlds when
    its next stage begins.
    """

    def __init__(
        self,
        config: TrainConfig,
        env: TrainableTask,
        predictor: BallPredictor,
        run: RunFolder | None,
        group: ProcessGroup | None = None,
        curriculum: Curriculum[Any] | None = None,
    ) -> None:
        self.curriculum = curriculum
        self.config, self.env, self.predictor, self.run = config, env, predictor, run
        self.group = group = group or ProcessGroup()
        self.device = env.policy_observation.device
        self.num_worlds, policy_size = env.policy_observation.shape
        sizes = Sizes(policy_size, env.critic_observation.shape[1], env.action_spec.shape[-1])
        self.algorithm = ALGORITHMS[config.algo.algorithm](sizes, config.algo, self.device, group)
        group.broadcast_([tensor for _, module in self._networks() for tensor in module.state_dict().values()])
        self.regression = PredictorTrainer(
            predictor, config.predictor, config.algo.steps, self.num_worlds, group, env.graphs
        )
        networks = [module for _, module in self._networks()]
        self._update = Update(self.algorithm, self.regression, networks, config.robot.control_dt, group)
        self.updates, self.samples, self.wall_s = 0, 0, 0.0
        self.plan = Plan(config)
        learners = {LEARNER: self.algorithm, "regression": self.regression}
        self._recovery = Recovery(config, dict(self._networks()), learners, run, group)
        self.stop = StopRequest()
        #: Of the run's policy, after each checkpoint; only rank 0 has one.
        self.judge: Judge | None = None
        self._saved_at = time.monotonic()

    def train(self) -> Summary | None:
        """Run until ``samples``, ``minutes`` or a signal; writes checkpoints, metrics and the learning curve.

        Returns the summary on rank 0, and None on the other ranks.

        Errors: :class:`RolloutError` if values are not finite in more than ``algo.skips`` updates in a row. The weights
        before them are then saved in ``last_good/`` (for ``init_from``), and the last checkpoint stays the newest (for
        ``resume``).
        """
        config = self.config
        if self.samples >= config.samples:
            raise ConfigError(f"the run has {self.samples} samples and samples={config.samples:g}: nothing left to do")
        shown = config.progress and self.group.is_rank_0
        progress = Progress(shown, config.samples, 60.0 * config.minutes, self.samples)
        started = last = time.monotonic()
        wall_before, reason, newest = self.wall_s, None, None
        judged: dict[str, float] = {}
        try:
            if self.run is not None:
                self.run.begin()
            with self.stop.listening():
                while reason is None:
                    row = self._safe_update() | judged
                    now = time.monotonic()
                    self.wall_s = wall_before + now - started
                    row |= {"wall_s": self.wall_s, "samples_per_s": self._samples_per_update / (now - last)}
                    last = now
                    progress.show(row)
                    if self.run is not None:
                        self.run.log(row)
                    self._measure(now - started, progress)
                    reason, due = self._asked(now - started)
                    if (due and not self._recovery.in_a_row) or reason is not None:
                        newest = self.save(last=reason is not None)
                    judged = self._judge(newest) if due and reason is None else {}
        finally:
            progress.close()
            if self.run is not None:
                self.run.close()
        if self.run is None or newest is None:
            return None
        curve, rates = plot_learning_curve(self.run.path), progress.rates()
        faults = progress.fault_texts()
        return Summary(reason, self.updates, self.samples, self.wall_s, newest, curve, rates, faults)

    def _safe_update(self) -> dict[str, float]:
        """:meth:`update`; one that is not finite is undone and counted. The control steps of its rollout count."""
        row = self._recovery.attempt(self.update, self.env, self._counters())
        if row is not None:
            return row | {"skipped": 0.0}
        self.algorithm.weights_loaded(new_run=False)
        self.samples += self._samples_per_update
        self.updates += 1
        return {"update": self.updates, "samples": self.samples, "skipped": 1.0}

    def _networks(self) -> tuple[tuple[str, nn.Module], ...]:
        return (("agent", self.algorithm.agent), ("predictor", self.predictor))

    def _counters(self) -> dict[str, float]:
        counted = {"updates": self.updates, "samples": self.samples, "wall_s": self.wall_s}
        return counted if self.plan.samples is None else counted | {PLANNED: self.plan.samples}

    @property
    def agent(self) -> nn.Module:
        """All networks that the algorithm trains."""
        return self.algorithm.agent

    @property
    def _samples_per_update(self) -> int:
        return self.group.size * self.num_worlds * self.regression.steps

    def _move_on(self) -> None:
        """Take the next stage's worlds if it begins; called after an update, so that a checkpoint holds them."""
        if self.curriculum is not None and self.curriculum.move_on(self.plan.position(self.samples)):
            self.env.warn_of_overflow()
            self.env = self.curriculum.worlds

    def update(self) -> dict[str, float]:
        """One rollout and one training update on it; returns the row of metrics, without the times.

        Errors: see :class:`pace.rl.update.Update`.
        """
        metrics = self._update(self.env, self.plan.position(self.samples))
        self.samples += self._samples_per_update
        self.updates += 1
        if self.config.curriculum and self.curriculum is not None:
            metrics["stage"] = float(self.curriculum.stage)
        self._move_on()
        return {"update": self.updates, "samples": self.samples, **metrics}

    def _measure(self, seconds: float, progress: Progress) -> None:
        """Fix the plan on all ranks once rank 0 has measured its speed."""
        if not self.plan.open:
            return
        found = self.plan.measure(self.samples, seconds) if self.group.is_rank_0 else None
        self.plan.samples, said = self.group.broadcast_object(found or (None, ""))
        if said and self.group.is_rank_0:
            progress.say(said)

    def _asked(self, seconds: float) -> tuple[str | None, bool]:
        """Why the run ends now, if it does, and whether a checkpoint is due, as rank 0 says; a signal to any rank ends
        the run."""
        asked = self.group.gather((self.stop.name, self._reason_to_end(seconds), self._save_is_due()))
        _, reason, due = asked[0]
        signal = next((name for name, *_ in asked if name is not None), None)
        if signal is None:
            return reason, due
        self.stop.name = signal
        return f"stopped by {signal}", due

    def _reason_to_end(self, seconds: float) -> str | None:
        if self.samples >= self.config.samples:
            return f"samples={self.config.samples:g} reached"
        if 0 < 60.0 * self.config.minutes <= seconds:
            return f"minutes={self.config.minutes:g} reached"
        return None

    def _save_is_due(self) -> bool:
        return time.monotonic() - self._saved_at >= 60.0 * self.config.checkpoint_minutes

    def save(self, last: bool = False) -> Path | None:
        """Write a checkpoint of the current state and delete old ones; see :meth:`RunFolder.save`. None on other ranks.

        Errors: :class:`CheckpointError` if the ``last`` one of the run cannot be written.
        """
        self.env.warn_of_overflow()
        checkpoint = self.checkpoint()
        self._saved_at = time.monotonic()
        return self.run.save(self.updates, checkpoint, last) if self.run is not None else None

    def _judge(self, checkpoint: Path | None) -> dict[str, float]:
        """The judgement of a checkpoint that was just written, for the next row of the metrics."""
        if self.judge is None or checkpoint is None:
            return {}
        return self.judge.quick(checkpoint, self.wall_s / 60.0)

    def checkpoint(self) -> Checkpoint:
        """Everything that the next update depends on, of all ranks."""
        env = {key: value.cpu() if isinstance(value, Tensor) else value for key, value in self.env.state_dict().items()}
        own = {"random": torch.get_rng_state(), "env": env}
        if self.device.type == "cuda":
            own["random_cuda"] = torch.cuda.get_rng_state(self.device)
        return Checkpoint(
            config=to_dict(self.config),
            counters=self._counters(),
            weights={part: module.state_dict() for part, module in self._networks()},
            training={
                LEARNER: self.algorithm.state_dict(),
                "regression": self.regression.state_dict(),
                PROCESSES: self.group.gather(own),
            },
        )

    def load_weights(self, checkpoint: Checkpoint) -> None:
        """Load another run's policy, critic, normalisers and predictor, or a predictor's weights alone.

        Errors: :class:`CheckpointError` for a missing or reshaped tensor.
        """
        if "predictor" not in checkpoint.weights:
            raise CheckpointError(f"{checkpoint.path}: the weights of the predictor are missing")
        for part, module in self._networks():
            if part in checkpoint.weights:
                cure = "; predictor_from=RUN takes another run's" if part == "predictor" else ""
                load_weights(module, checkpoint.weights[part], f"{checkpoint.path} ({part}{cure})")

    def start_from(self, checkpoint: Checkpoint) -> None:
        """:meth:`load_weights`, for a new run.

        Errors: those of :meth:`load_weights`.
        """
        self.load_weights(checkpoint)
        self.algorithm.weights_loaded(new_run=True)

    def resume(self, checkpoint: Checkpoint) -> None:
        """Resume exactly from the state in ``checkpoint``.

        If :func:`restarts_worlds` is true, the worlds are the new ones of the environment. MuJoCo Warp on a GPU sums in
        no fixed order: there a run resumes from the same state, but not bit for bit.

        Errors: :class:`CheckpointError` when it holds weights only or does not fit this configuration.
        """
        state = checkpoint.training
        if state is None:
            raise CheckpointError(f"{checkpoint.path} holds weights only: use init_from instead of resume")
        self.load_weights(checkpoint)
        self.algorithm.weights_loaded(new_run=False)
        try:
            self.algorithm.load_state_dict(state[LEARNER if LEARNER in state else OLD_LEARNER])
            self.regression.load_state_dict(state["regression"])
            if not restarts_worlds(checkpoint, self.group, self.device):
                self._resume_worlds(state[PROCESSES][self.group.rank])
        except (KeyError, ValueError, RuntimeError) as error:
            raise CheckpointError(f"{checkpoint.path} does not fit this configuration: {error}") from error
        self.updates, self.samples = int(checkpoint.counters["updates"]), int(checkpoint.counters["samples"])
        self.wall_s = float(checkpoint.counters["wall_s"])
        self.plan.samples = checkpoint.counters.get(PLANNED, self.plan.samples)

    def _resume_worlds(self, own: dict[str, Any]) -> None:
        """Load this process's worlds and random number generators, as :meth:`checkpoint` saved them."""
        self.env.load_state_dict(own["env"])
        torch.set_rng_state(own["random"])
        if "random_cuda" in own:
            torch.cuda.set_rng_state(own["random_cuda"], self.device)


def restarts_worlds(checkpoint: Checkpoint, group: ProcessGroup, device: torch.device) -> bool:
    """Whether a run that resumes ``checkpoint`` needs new worlds: number of processes or device type differs."""
    return len(_processes(checkpoint)) != group.size or device_type_of(checkpoint) != device.type


def device_type_of(checkpoint: Checkpoint) -> str:
    """Device type, cpu or cuda, of the worlds of a checkpoint's run."""
    return "cuda" if any("random_cuda" in own for own in _processes(checkpoint)) else "cpu"


def _processes(checkpoint: Checkpoint) -> list[dict[str, Any]]:
    """The saved state of each process of a checkpoint's run; empty if it holds weights only."""
    return checkpoint.training[PROCESSES] if checkpoint.training else []
