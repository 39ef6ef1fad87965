"""One world to watch: serve after serve, the state at any instant between control steps, and the robot's estimates.

The page and the video of :mod:`pace.viewer` draw what :meth:`Show.advance` returns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pace.config.overrides import ON_A_CPU, override_task, without_reward
from pace.config.task import TaskConfig
from pace.rl.policies import TaskPolicy
from pace.sim.ball.ball import BallParams, BallSim
from pace.sim.render import Ball, Line, Mark
from pace.task.env import TableTennisEnv
from pace.task.game import Outcome
from pace.task.resets import ServeSampler
from pace.viewer.bars import RewardBars

Array = NDArray[np.float64]

#: Overrides of the saved task in a show, before the user's: the paper's evaluation, one world on a CPU.
SHOW_OVERRIDES = ("serve=mixed", "reset=evaluation", *ON_A_CPU)
FLIGHT_DT = 0.01  # s between the points of a flight line
FLIGHT_POINTS = 200
FLIGHT_COLOUR = (0.95, 0.35, 0.1, 1.0)
APEX_COLOUR, PREDICTION_COLOUR, BASE_COLOUR = (0.1, 0.8, 0.25, 1.0), (1.0, 0.9, 0.1, 1.0), (0.15, 0.4, 1.0, 1.0)
APEX_RADIUS, PREDICTION_RADIUS, BASE_RADIUS = 0.024, 0.03, 0.05  # m
FLIGHT_WIDTH = 2.0  # pixels
OUTCOME_NAMES = {
    Outcome.SUCCESS: "returned",
    Outcome.MISS: "missed",
    Outcome.NET: "into the net",
    Outcome.OUT: "out",
    Outcome.OWN_SIDE: "onto the own side",
    Outcome.DOUBLE_HIT: "hit twice",
    Outcome.VOLLEY: "hit before the bounce",
    Outcome.BODY: "touched by the body",
    Outcome.TABLE_TOUCH: "pushed the table",
    Outcome.FREE_HAND: "free hand on the table",
    Outcome.FALL: "fell",
    Outcome.BAD_SERVE: "a serve beside the table",
}


@dataclass(frozen=True)
class Serve:
    """A serve to play: m/s over the ground, degrees to the robot's left, m/s upwards, rad/s of top and side spin."""

    speed: float
    direction: float
    upward: float
    topspin: float = 0.0
    sidespin: float = 0.0

    def velocity(self) -> list[float]:
        """(3,) m/s, world frame."""
        angle = math.radians(self.direction)
        return [-self.speed * math.cos(angle), self.speed * math.sin(angle), self.upward]

    def spin(self) -> list[float]:
        """(3,) rad/s, world frame: topspin turns the ball's upper side towards the robot."""
        return [0.0, -self.topspin, self.sidespin]


class ChosenServes(ServeSampler):
    """Samples serves as the task does, or returns the chosen one.

    Attributes: ``choice``, ``None`` for random serves.
    """

    choice: Serve | None = None

    def sample(self, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`ServeSampler.sample`."""
        position, velocity, spin = super().sample(mask)
        if self.choice is None:
            return position, velocity, spin
        velocity.copy_(torch.tensor(self.choice.velocity()))
        spin.copy_(torch.tensor(self.choice.spin()))
        return position, velocity, spin


class ShowEnv(TableTennisEnv):
    """One world whose serves can be chosen, and ended.

    Attributes: ``chosen`` the source of its serves.
    """

    chosen: ChosenServes

    def _make_serves(self) -> ChosenServes:
        self.chosen = ChosenServes(self.config.serve, self.worlds.ball, self.generator)
        return self.chosen

    def end_serve(self) -> None:
        """End the current serve; the next one begins with the next control step."""
        self.game.clock.time.fill_(self.config.serve.max_duration)


class FlightLine:
    """The coming flight of a ball, if no paddle touches it."""

    def __init__(self, config: TaskConfig) -> None:
        params = BallParams.from_config(config.ball)
        self._ball = BallSim(1, "cpu", params, config.ball.table, FLIGHT_DT, 1, config.engine.ball_dt, config.ball.air)
        self._far = torch.zeros(1, 2, 12)
        self._far[..., 2] = 100.0  # m: a paddle out of reach
        self._far[..., 3] = 1.0

    def points(self, ball: BallSim) -> Array:
        """(M, 3) m, from the current state of the world of ``ball`` until the floor."""
        own, events = self._ball, self._ball.events
        for f in fields(BallParams):
            getattr(own.params, f.name).copy_(getattr(ball.params, f.name))
        for name in ("position", "velocity", "spin"):
            getattr(own, name).copy_(getattr(ball, name))
        points = [own.position[0].tolist()]
        for _ in range(FLIGHT_POINTS):
            own.fly(self._far)
            if int(events.own_bounce + events.opponent_bounce):
                points.append(events.bounce_position[0].tolist())
            points.append(own.position[0].tolist())
            if int(events.floor):
                break
        return np.array(points)


@dataclass
class Score:
    """Counts of finished serves and their outcomes."""

    serves: int = 0
    hits: int = 0
    returns: int = 0
    last: str = ""

    def text(self) -> str:
        """In one line."""
        shares = [f"{n} ({100 * n / self.serves:.0f} %)" if self.serves else str(n) for n in (self.hits, self.returns)]
        end = f" | last: {self.last}" if self.last else ""
        return f"serves {self.serves} | hits {shares[0]} | returns {shares[1]}{end}"


@dataclass(frozen=True)
class Snapshot:
    """Everything to draw at one instant, world frame, m. ``flight_number`` counts the flight lines."""

    qpos: Array  # (7 + J,)
    ball: Array  # (3,)
    flight: Array  # (M, 3)
    flight_number: int
    apex: Array | None  # (3,) of the simulated flight; None while there is nothing to hit
    prediction: Array | None  # (3,) learned; None while the robot believes that there is nothing to hit
    base_target: Array  # (3,) on the floor

    def marks(self) -> list[Mark]:
        """Flight line, apex green, learned prediction yellow, base target blue."""
        marks: list[Mark] = [
            Line(self.flight, FLIGHT_WIDTH, FLIGHT_COLOUR),
            Ball(self.base_target, BASE_RADIUS, BASE_COLOUR),
        ]
        if self.apex is not None:
            marks.append(Ball(self.apex, APEX_RADIUS, APEX_COLOUR))
        if self.prediction is not None:
            marks.append(Ball(self.prediction, PREDICTION_RADIUS, PREDICTION_COLOUR))
        return marks


class Show:
    """A policy that plays serve after serve in one world; after a fall the robot is reset.

    Attributes: ``env``, ``score``, ``bars`` of the reward terms (``None`` without ``rewards``).

    Args:
        policy: as :func:`pace.rl.load_policy` gives it.
        overrides: of the saved task, after those of :data:`SHOW_OVERRIDES`.
        seed: of all random numbers.
        rewards: whether to compute the saved reward, whose terms must then be known.

    Errors: :class:`pace.config.ConfigError` for a wrong override, and an unknown reward term.
    """

    def __init__(self, policy: TaskPolicy, overrides: Sequence[str] = (), seed: int = 1, rewards: bool = False) -> None:
        self.policy = policy.to("cpu")
        config = override_task(policy.config, [*SHOW_OVERRIDES, *overrides, "serve.serves_per_episode=0"])
        self.env = ShowEnv(config if rewards else without_reward(config), 1, "cpu", seed, policy.predictor)
        self.bars = RewardBars(self.env.rewards.names, self.control_dt) if rewards else None
        self.score = Score()
        self.flights = 0
        self._line = FlightLine(config)
        self._ahead = 0.0  # s into the control step that is shown
        self._skipped = False
        self._see_flight()
        self._step()

    def next_serve(self, serve: Serve | None) -> None:
        """End the current serve, which then does not count; play ``serve`` from now on, or random ones if ``None``."""
        self.choose(serve)
        self.env.end_serve()
        self._skipped = True

    def choose(self, serve: Serve | None) -> None:
        """The next serve."""
        self.env.chosen.choice = serve

    @property
    def config(self) -> TaskConfig:
        """The task that is played."""
        return self.env.config

    def text(self) -> str:
        """The score in one line."""
        return self.score.text()

    @property
    def control_dt(self) -> float:
        """s between control steps."""
        return self.env.worlds.control_dt

    def advance(self, seconds: float) -> Snapshot:
        """The snapshot after ``seconds`` more of play."""
        self._ahead += seconds
        while self._ahead > self.control_dt:
            self._ahead -= self.control_dt
            self._step()
        return self._snapshot()

    def _step(self) -> None:
        env = self.env
        self._ball_before = env.worlds.ball.position[0].numpy().astype(np.float64)
        env.advance(self.policy(env.policy_observation))
        if self.bars is not None:
            self.bars.update(env.rewards.weighted[:, 0].double().numpy())
        self._qpos_path = env.worlds.engine.qpos_path[0].numpy().astype(np.float64)
        self._ball_knots = self._knots()
        if bool(env.serve_over):
            self._count(Outcome(int(env.serve_outcome)), bool(env.serve_hit))
        if bool(env.terminated):
            env.reset_worlds(env.terminated)
        if bool(env.serve_over) or int(env.worlds.ball.events.paddle_hit):
            self._see_flight()

    def _knots(self) -> tuple[list[float], Array]:
        """Times (s into the step) and positions (K, 3) of the ball, to interpolate linearly."""
        events, ball = self.env.worlds.ball.events, self.env.worlds.ball
        bounce = min(float(events.own_bounce_time), float(events.opponent_bounce_time))
        knots = [(0.0, self._ball_before)]
        for time, place in ((bounce, events.bounce_position), (float(events.paddle_hit_time), events.hit_position)):
            if time < self.control_dt:
                knots.append((time, place[0].numpy().astype(np.float64)))
        if not bool(self.env.serve_over):  # else the ball is already the next one
            knots.append((self.control_dt, ball.position[0].numpy().astype(np.float64)))
        knots.sort(key=lambda knot: knot[0])
        return [time for time, _ in knots], np.array([place for _, place in knots])

    def _count(self, outcome: Outcome, hit: bool) -> None:
        score, skipped = self.score, self._skipped
        self._skipped = False
        score.last = "skipped" if skipped else OUTCOME_NAMES[outcome]
        if not skipped and outcome != Outcome.BAD_SERVE:
            score.serves += 1
            score.hits += hit
            score.returns += outcome == Outcome.SUCCESS

    def _see_flight(self) -> None:
        self._flight = self._line.points(self.env.worlds.ball)
        self.flights += 1

    def _snapshot(self) -> Snapshot:
        env, game, actor = self.env, self.env.game, self.env.actor
        last = len(self._qpos_path) - 1
        instant = min(round(self._ahead / self.control_dt * last), last)
        times, places = self._ball_knots
        stand = (env.sensing.base_position[0, :2] + actor.shift[0]).numpy()
        predicted = bool(actor.track.something_to_hit) and actor.predictor is not None
        return Snapshot(
            qpos=self._qpos_path[instant],
            ball=np.array([np.interp(self._ahead, times, places[:, axis]) for axis in range(3)]),
            flight=self._flight,
            flight_number=self.flights,
            apex=game.target.apex[0].numpy().copy() if bool(game.target.something_to_hit) else None,
            prediction=actor.apex[0].numpy().copy() if predicted else None,
            base_target=np.array([*stand, 0.0]),
        )
