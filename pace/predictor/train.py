"""``python -m pace.predictor.train``: train the predictor alone, on simulated serves without a robot.

Serves do not depend on the robot, so the predictor can be trained before any policy. The ball, its randomisation, the
sensors' delay and noise and the meaning of the outputs are those of the task, from the same code and configuration.

Examples::

    python -m pace.predictor.train                                  # the task of configs/train.yaml
    python -m pace.predictor.train predictor=paper sensing=clean samples=2e6
    python -m pace.predictor.train predictor=filter                 # the whole flight for five positions
    python -m pace.rl.train init_from=runs/2026-01-01_predictor     # a policy that starts with this predictor
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import torch
from omegaconf import DictConfig
from torch import Tensor

from pace.command import run_command
from pace.config import ConfigError, TrainConfig, parse, to_dict
from pace.predictor.network import PredictorNetwork
from pace.predictor.regression import PredictorTrainer
from pace.rl.checkpoint import FOLDER, Checkpoint, save_checkpoint
from pace.rl.observations import BallTrack
from pace.rl.progress import Progress
from pace.rl.run_folder import METRICS, RunFolder, default_run_dir
from pace.rl.task import Game, ServeSampler
from pace.rl.trainer import StopRequest
from pace.sim.ball import BallParams, BallSim
from pace.sim.engine import EngineParams, resolve_device
from pace.sim.randomization import Randomizer
from pace.sim.robot import build_model
from pace.sim.sensing import Sensing

RESULT = "predictor.json"
FINAL_ROLLOUTS = 20  # rollouts of the final measurement, which are never fitted
SPREAD_STEPS = 50  # control steps, about as long as a serve
STANDING = (-1.8, 0.0, 0.7)  # m, base of a robot that does not fall and plays no part
FAR_AWAY = 100.0  # m, where the paddle is that nobody holds


class ServePractice:
    """Serves of N worlds, one after another, sensed as the robot's motion capture would: source of the regression.

    Attributes, overwritten by :meth:`advance`: ``predictor_input`` (N, 3 frames) m, ``predictor_target`` (N, out),
    ``predictor_valid`` (N,) bool, ``predictor_time_to_apex`` (N,) s, as those of :class:`pace.rl.TableTennisEnv`;
    ``serve_over`` (N,) bool, the serve ended in this step and the next has begun. Besides: ``ball``
    (:class:`pace.sim.ball.BallSim`) and ``sensing`` (:class:`pace.sim.sensing.Sensing`).
    """

    def __init__(self, config: TrainConfig, device: torch.device) -> None:
        count = config.num_worlds
        self.config, self.device = config, device
        self.generator = torch.Generator(device).manual_seed(config.seed)
        self.ball = BallSim(
            count,
            device,
            BallParams.from_config(config.ball),
            config.ball.table,
            config.robot.control_dt,
            1,
            config.engine.ball_dt,
        )
        self._randomizer = self._make_randomizer()
        self._serves = ServeSampler(config.serve, count, self.generator, device)
        self._game = Game(config, self.ball, torch.tensor(STANDING, device=device).repeat(count, 1))
        self._track = BallTrack(config.predictor.frames, self._game.rules, count, device)
        self._path = torch.full((count, 2, 12), FAR_AWAY, device=device)
        self._path[:, :, 3:] = torch.tensor([1.0, *[0.0] * 8], device=device)  # a unit normal, at rest
        still = {name: torch.zeros(count, size, device=device) for name, size in STILL_ROBOT.items()}
        self._robot: SimpleNamespace = SimpleNamespace(**still)
        joints = torch.zeros(0, device=device)
        self.sensing = Sensing(config.sensing, count, device, config.robot.control_dt, joints, self.generator)
        self.predictor_input = self._track.positions
        self.serve_over = self._game.ends.over
        self._serve(torch.ones(count, dtype=torch.bool, device=device))
        self._sense(torch.ones(count, dtype=torch.bool, device=device))

    def _make_randomizer(self) -> Randomizer:
        config = self.config
        model = build_model(config.robot, config.engine, config.ball.table)
        unused = EngineParams.nominal(model, config.num_worlds, self.device)
        control_dt, ball = config.robot.control_dt, self.ball.params
        return Randomizer(config.randomization, config.ball, unused, ball, self.generator, model.nv, control_dt)

    def spread(self) -> None:
        """Begin serves at random times, so that every rollout holds all stretches of a flight; they began together."""
        first = torch.randint(SPREAD_STEPS, (self.config.num_worlds,), generator=self.generator, device=self.device)
        for step in range(SPREAD_STEPS):
            self.advance(first == step)

    @torch.no_grad()
    def advance(self, also: Tensor | None = None) -> None:
        """One control step; a serve that is over is followed by the next, with another ball and another delay, as are
        those of ``also`` (N,) bool."""
        self.ball.fly(self._path)
        self._game.judge()
        self._game.close()
        over = self._game.ends.over if also is None else self._game.ends.over | also
        self._serve(over)
        self._sense(over)

    def _serve(self, mask: Tensor) -> None:
        ball, wide = self.ball, mask.unsqueeze(-1)
        self._randomizer.draw(mask)
        launch = self._serves.sample(mask)
        for value, start in zip((ball.position, ball.velocity, ball.spin), launch, strict=True):
            value.copy_(torch.where(wide, start, value))
        ball.forecast(mask, ball.position, ball.velocity, ball.spin, self.config.reward.target_x)
        self._game.start_serve(mask)

    def _sense(self, new_ball: Tensor) -> None:
        self.sensing.update(self._robot, self.ball.position, new_ball)  # type: ignore[arg-type]
        self.sensing.reset(new_ball, self._robot, self.ball.position)  # type: ignore[arg-type]
        self._track.update(self.sensing.ball_position, new_ball)
        target, now = self._game.target, self._game.clock.time
        parts = {"apex": target.apex, "target": target.point, "target_time": (target.time - now).unsqueeze(-1)}
        self.predictor_target = torch.cat([parts[name] for name in self.config.predictor.outputs], dim=1)
        self.predictor_time_to_apex = target.apex_time - now
        self.predictor_valid = target.something_to_hit


STILL_ROBOT = {
    "base_angular_velocity": 3,
    "projected_gravity": 3,
    "joint_position": 0,
    "joint_velocity": 0,
    "base_position": 3,
    "heading": 2,
}


class PredictorRun:
    """Trains one predictor on :class:`ServePractice` until ``samples`` or ``minutes``, and measures it."""

    def __init__(self, config: TrainConfig) -> None:
        if not config.predictor.enabled:
            raise ConfigError("predictor.enabled is false: there is nothing to train")
        device = resolve_device(config.device)
        torch.manual_seed(config.seed)
        self.config = config
        self.network = PredictorNetwork(config.predictor).to(device)
        self.practice = ServePractice(config, device)
        self.practice.spread()
        self.trainer = PredictorTrainer(self.network, config.predictor, config.algo.steps, config.num_worlds)

    def play(self) -> None:
        """Record one rollout."""
        for t in range(self.trainer.steps):
            self.practice.advance()
            self.trainer.record(t, self.practice)

    def slow_down(self, done: float) -> None:
        """Learning rate for the share ``done`` of the way: half a cosine, to a hundredth of ``learning_rate``."""
        factor = 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * done))
        for group in self.trainer.optimiser.param_groups:
            group["lr"] = factor * self.config.predictor.learning_rate

    def train(self, run: RunFolder) -> dict[str, float]:
        """Fit rollout after rollout, each measured before it is fitted, to the end or to the first Ctrl-C or SIGTERM;
        returns updates, samples and seconds."""
        config, per_update = self.config, self.config.num_worlds * self.config.algo.steps
        progress = Progress(config.progress, config.samples, 60.0 * config.minutes, shown=["predictor_rmse_cm"])
        started = last = time.monotonic()
        update, limit, stop = 0, 60.0 * config.minutes if config.minutes > 0 else math.inf, StopRequest()
        with stop.listening():
            while (done := max(update * per_update / config.samples, (last - started) / limit)) < 1 and not stop.name:
                self.slow_down(done)
                self.play()
                update += 1
                errors, now = self.trainer.update(), time.monotonic()
                row = {"update": update, "samples": update * per_update, "wall_s": now - started, **errors}
                row["samples_per_s"] = per_update / (now - last)
                last = now
                run.log(row)
                progress.show(row)
        progress.close()
        return {"updates": update, "samples": update * per_update, "wall_s": last - started}

    def measure(self) -> dict[str, float]:
        """RMSE in cm, root of the mean square over rollouts that are not fitted; NaN bins are left out."""
        squares: dict[str, list[float]] = {}
        for _ in range(FINAL_ROLLOUTS):
            self.play()
            for name, value in self.trainer.errors().items():
                squares.setdefault(name, []).extend([value**2] if value == value else [])
        return {name: (sum(values) / len(values)) ** 0.5 for name, values in squares.items() if values}


def train_predictor(composed: DictConfig) -> None:
    """Train as the composed configuration says, and print what was written."""
    config = parse(composed, TrainConfig)
    session = PredictorRun(config)
    config.run_dir = config.run_dir or str(default_run_dir(config.name))
    run = RunFolder(Path(config.run_dir), to_dict(config), config.tensorboard)
    print(f"training the predictor on serves in {config.num_worlds} worlds, run folder {run.path}", flush=True)
    counters = session.train(run)
    run.close()
    errors = session.measure()
    weights = {"predictor": session.network.state_dict()}
    folder = run.path / FOLDER / f"update_{int(counters['updates']):08d}"
    save_checkpoint(folder, Checkpoint(to_dict(config), counters, weights, None))
    result = {"errors": errors, "counters": counters, "ball": config.ball.name, "serve": config.serve.name}
    (run.path / RESULT).write_text(json.dumps(result, indent=1))
    for name, value in errors.items():
        print(f"{name}: {value:.2f}")
    for file in (folder, run.path / RESULT, run.path / METRICS):
        print(f"wrote {file}")


if __name__ == "__main__":
    sys.exit(run_command(train_predictor, "predictor_train"))
