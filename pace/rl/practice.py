"""Serves without a robot, to train the predictor."""

from __future__ import annotations

import torch
from torch import Tensor

from pace.arrays.tensors import allocate
from pace.config.training import TrainConfig
from pace.onboard.ball_track import BallTrack
from pace.sim.ball.ball import BallParams, BallSim
from pace.sim.engine.base import EngineParams
from pace.sim.randomization import Randomizer
from pace.sim.robot import build_model
from pace.sim.robot_state import RobotState
from pace.sim.sensing import Sensing
from pace.task.game import Game
from pace.task.resets import ServeSampler

DESYNCHRONISE_STEPS = 50  # control steps, about as long as a serve


STANDING = (-1.8, 0.0, 0.7)  # m, base of a robot that stands still


FAR_AWAY = 100.0  # m, position of a paddle that no ball meets


class ServePractice:
    """Serves of N worlds, one after another, sensed as the robot's motion capture would: source of the regression.

    Attributes, overwritten by :meth:`advance`: ``predictor_input`` (N, 3 frames) m, ``predictor_target`` (N, out),
    ``predictor_valid`` (N,) bool, ``predictor_time_to_apex`` (N,) s, as those of :class:`pace.rl.TableTennisEnv`;
    ``serve_over`` (N,) bool, the serve ended in this step and the next has begun. Besides: ``ball``
    (:class:`pace.sim.ball.BallSim`), ``sensing`` (:class:`pace.sim.sensing.Sensing`) and ``serves``
    (:class:`pace.task.resets.ServeSampler`).
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
            config.ball.air,
        )
        self._randomizer = self._make_randomizer()
        self.serves = ServeSampler(config.serve, self.ball, self.generator)
        self._game = Game(config, self.ball, torch.tensor(STANDING, device=device).repeat(count, 1))
        self._track = BallTrack(config).to(device)
        self._path = torch.full((count, 2, 12), FAR_AWAY, device=device)
        self._path[:, :, 3:] = torch.tensor([1.0, *[0.0] * 8], device=device)  # a unit normal, at rest
        self._robot = allocate(RobotState, count, device, joints=0, feet=0, bodies=0)
        joints = torch.zeros(0, device=device)
        self.sensing = Sensing(config.sensing, count, device, config.robot.control_dt, joints, self.generator)
        self.predictor_input = torch.zeros(count, 3 * config.predictor.frames, device=device)
        self.serve_over = self._game.ends.over
        self._serve(torch.ones(count, dtype=torch.bool, device=device))
        self._sense(torch.ones(count, dtype=torch.bool, device=device))

    def _make_randomizer(self) -> Randomizer:
        config = self.config
        model = build_model(config.robot, config.engine, config.ball.table)
        unused = EngineParams.nominal(model, config.num_worlds, self.device)
        control_dt, ball = config.robot.control_dt, self.ball.params
        return Randomizer(config.randomization, config.ball, unused, ball, self.generator, model.nv, control_dt)

    def desynchronise(self) -> None:
        """Desynchronise the serves, which began together: every rollout then holds all parts of a flight."""
        first = torch.randint(
            DESYNCHRONISE_STEPS, (self.config.num_worlds,), generator=self.generator, device=self.device
        )
        for step in range(DESYNCHRONISE_STEPS):
            self.advance(first == step)

    @torch.no_grad()
    def advance(self, also: Tensor | None = None) -> None:
        """One control step. A new serve, with another ball and another delay, replaces each serve that is over, and
        those of ``also`` (N,) bool."""
        self.ball.fly(self._path)
        self._game.judge()
        self._game.close()
        over = self._game.ends.over if also is None else self._game.ends.over | also
        self._serve(over)
        self._sense(over)

    def _serve(self, mask: Tensor) -> None:
        ball, wide = self.ball, mask.unsqueeze(-1)
        self._randomizer.sample(mask)
        launch = self.serves.sample(mask)
        for value, start in zip((ball.position, ball.velocity, ball.spin), launch, strict=True):
            value.copy_(torch.where(wide, start, value))
        ball.forecast(mask, ball.position, ball.velocity, ball.spin, self.config.reward.target_x)
        self._game.start_serve(mask)

    def _sense(self, new_ball: Tensor) -> None:
        self.sensing.update(self._robot, self.ball.position, new_ball)
        self.sensing.reset(new_ball, self._robot, self.ball.position)
        sensed = self.sensing.ball_position
        self.predictor_input.copy_(self._track.append(self.predictor_input, sensed, new_ball))
        target, now = self._game.target, self._game.clock.time
        parts = {"apex": target.apex, "target": target.point, "target_time": (target.time - now).unsqueeze(-1)}
        self.predictor_target = torch.cat([parts[name] for name in self.config.predictor.outputs], dim=1)
        self.predictor_time_to_apex = target.apex_time - now
        self.predictor_valid = target.something_to_hit
