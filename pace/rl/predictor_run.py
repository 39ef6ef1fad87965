"""The predictor trained alone, on simulated serves without a robot.

Serves do not depend on the robot, so the predictor can be trained before any policy. The ball, its randomisation, the
sensors' delay and noise and the meaning of the outputs are those of the task, from the same code and configuration.
"""

from __future__ import annotations

import json
import math
import time

import torch
from omegaconf import DictConfig

from pace.arrays.graph import graphs_of
from pace.config.base import ConfigError, parse, to_dict
from pace.config.training import TrainConfig
from pace.devices import resolve_device
from pace.predictor.network import make_predictor
from pace.predictor.priors import resolve_priors
from pace.predictor.regression import PredictorTrainer
from pace.rl.practice import ServePractice
from pace.runs.checkpoint import Checkpoint
from pace.runs.files import write_whole
from pace.runs.interrupt import StopRequest, terminable
from pace.runs.optimiser import learning_rate
from pace.runs.progress import Progress
from pace.runs.run_folder import METRICS, RunFolder

RESULT = "predictor.json"
FINAL_ROLLOUTS = 20  # rollouts of the final measurement, not used for training


class PredictorRun:
    """Trains one predictor on :class:`ServePractice` until ``samples`` or ``minutes``, and measures it."""

    def __init__(self, config: TrainConfig) -> None:
        if not config.predictor.enabled:
            raise ConfigError("predictor.enabled is false: there is nothing to train")
        device = resolve_device(config.device)
        torch.manual_seed(config.seed)
        config.predictor = resolve_priors(config)
        self.config = config
        self.stop = StopRequest()
        self.network = make_predictor(config.predictor).to(device)
        self.practice = ServePractice(config, device)
        self.practice.desynchronise()
        graphs = graphs_of(config.engine, device)
        self.trainer = PredictorTrainer(
            self.network, config.predictor, config.algo.steps, config.num_worlds, graphs=graphs
        )

    def play(self) -> None:
        """Record one rollout."""
        for t in range(self.trainer.steps):
            self.practice.advance()
            self.trainer.record(t, self.practice)

    def slow_down(self, done: float) -> None:
        """Learning rate for the share ``done`` of the run: half a cosine, to a hundredth of ``learning_rate``."""
        factor = 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * done))
        learning_rate(self.trainer.optimiser).fill_(factor * self.config.predictor.learning_rate)

    def train(self, run: RunFolder) -> dict[str, float]:
        """Fit rollout after rollout, to the end or to the first Ctrl-C or SIGTERM; each is measured before its fit.

        Writes a checkpoint every ``checkpoint_minutes``. Returns updates, samples and seconds.
        """
        config, per_update = self.config, self.config.num_worlds * self.config.algo.steps
        progress = Progress(config.progress, config.samples, 60.0 * config.minutes, shown=["predictor_rmse_cm"])
        started = last = saved_at = time.monotonic()
        update, limit = 0, 60.0 * config.minutes if config.minutes > 0 else math.inf
        with self.stop.listening():
            while (done := max(update * per_update / config.samples, (last - started) / limit)) < 1:
                if self.stop.name is not None:
                    break
                self.slow_down(done)
                self.play()
                update += 1
                errors, now = self.trainer.update(), time.monotonic()
                row = {"update": update, "samples": update * per_update, "wall_s": now - started, **errors}
                row["samples_per_s"] = per_update / (now - last)
                last = now
                run.log(row)
                progress.show(row)
                if now - saved_at >= 60.0 * config.checkpoint_minutes:
                    run.save(update, self.checkpoint(_counters(row)))
                    saved_at = now
        progress.close()
        return {"updates": update, "samples": update * per_update, "wall_s": last - started}

    def checkpoint(self, counters: dict[str, float]) -> Checkpoint:
        """The network, after ``counters`` of its training."""
        return Checkpoint(to_dict(self.config), counters, {"predictor": self.network.state_dict()}, None)

    def measure(self) -> dict[str, float]:
        """RMSE in cm, root of the mean square over rollouts that are not fitted, without NaN bins."""
        squares: dict[str, list[float]] = {}
        for _ in range(FINAL_ROLLOUTS):
            self.play()
            for name, value in self.trainer.errors().items():
                squares.setdefault(name, []).extend([value**2] if value == value else [])
        return {name: (sum(values) / len(values)) ** 0.5 for name, values in squares.items() if values}


def _counters(row: dict[str, float]) -> dict[str, float]:
    return {"updates": row["update"], "samples": row["samples"], "wall_s": row["wall_s"]}


def train_predictor(composed: DictConfig) -> None:
    """Train as the composed configuration says, and print what was written."""
    config = parse(composed, TrainConfig)
    # before the first second of work
    run = RunFolder(config.out, to_dict(config), config.tensorboard, files=[RESULT], logger=config.logger)
    config.out = str(run.path)
    try:
        with terminable():
            _train(config, run)
    except BaseException:
        run.abandon()
        raise


def _train(config: TrainConfig, run: RunFolder) -> None:
    session = PredictorRun(config)
    run.configure(to_dict(config))
    print(f"training the predictor on serves in {config.num_worlds} worlds, run folder {run.path}", flush=True)
    counters = session.train(run)
    folder = run.save(int(counters["updates"]), session.checkpoint(counters), last=True)  # measuring may be interrupted
    errors = session.measure()
    run.close()
    result = {"errors": errors, "counters": counters, "ball": config.ball.name, "serve": config.serve.name}
    write_whole(run.path / RESULT, json.dumps(result, indent=1))
    for name, value in errors.items():
        print(f"{name}: {value:.2f}")
    for file in (folder, run.path / RESULT, run.path / METRICS):
        print(f"wrote {file}")
    run.finish([run.path / RESULT])
    session.stop.require_not_terminated()
