"""Serves as points of a unit cube: the sampled quantities of a serve, and the sensed positions of its flight."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pace.config.task import SPINS
from pace.config.training import TrainConfig
from pace.rl.practice import ServePractice
from pace.sim.ball.ball import BallParams, BallSim
from pace.sim.randomization import BALL_LIMITS, SAMPLED_BALL_PARAMS
from pace.task.resets import world_spin

AXES = ("x", "y", "z")
FAR_AWAY = 100.0  # m, position of the paddle


class ServePrior:
    """The uniform distributions of a serve, its ball and its sensors, without those of zero width.

    ``names`` (D): position and velocity of the launch by axis (m, m/s), its topspin, sidespin and corkscrew (rad/s),
    ball parameters by name, and ``delay`` in control steps. ``low``, ``width`` (D,).
    """

    def __init__(self, config: TrainConfig) -> None:
        serve, randomization, ball = config.serve, config.randomization, config.ball
        ranges = {f"position_{axis}": getattr(serve, axis) for axis in AXES}
        ranges |= {f"velocity_{axis}": getattr(serve, f"v{axis}") for axis in AXES}
        ranges |= {name: getattr(serve, name) for name in SPINS}
        for name, (range_name, scales) in SAMPLED_BALL_PARAMS.items():
            nominal, (low, high) = float(getattr(ball, name)), getattr(randomization, range_name)
            ranges[name] = [nominal * low, nominal * high] if scales else [nominal + low, nominal + high]
        ranges["delay"] = [bound / config.robot.control_dt for bound in config.sensing.mocap_delay]
        self.fixed = {name: low for name, (low, high) in ranges.items() if high <= low}
        self.names = [name for name in ranges if name not in self.fixed and not name.startswith("paddle")]
        self.low = torch.tensor([ranges[name][0] for name in self.names])
        self.width = torch.tensor([ranges[name][1] - ranges[name][0] for name in self.names])

    def values(self, cube: Tensor) -> dict[str, Tensor]:
        """Points (M, D) of the unit cube -> every sampled quantity (M,) by name."""
        sampled = self.low + self.width * cube
        found = {name: torch.full((len(cube),), value) for name, value in self.fixed.items()}
        found |= {name: sampled[:, i] for i, name in enumerate(self.names)}
        for name, (low, high) in BALL_LIMITS.items():
            if name in found:
                found[name] = found[name].clamp(low, high)
        return found

    def cube(self, values: dict[str, Tensor]) -> Tensor:
        """Inverse of :meth:`values`, (M, D); if a limit clamps a sample, one of the points that give it."""
        sampled = torch.stack([values[name] for name in self.names], dim=1)
        return ((sampled - self.low) / self.width).clamp(0.0, 1.0)


class FlightModel:
    """Flies M serves as the task does, with the simulation's ball; no robot, no noise."""

    def __init__(self, config: TrainConfig, count: int) -> None:
        self.prior, self.config = ServePrior(config), config
        dt = config.robot.control_dt
        params = BallParams.from_config(config.ball)
        self._ball = BallSim(count, "cpu", params, config.ball.table, dt, 1, config.engine.ball_dt, config.ball.air)
        self._path = torch.full((count, 2, 12), FAR_AWAY)
        self._path[:, :, 3:] = torch.tensor([1.0, *[0.0] * 8])
        self._everyone = torch.ones(count, dtype=torch.bool)

    def sensed(self, cube: Tensor, frames: int) -> Tensor:
        """Ball positions (M, frames, 3) m as delayed sensors would report them without noise, for points (M, D)."""
        values = self._launch(cube)
        flight = [self._ball.position.clone()]
        for _ in range(frames - 1):
            self._ball.fly(self._path)
            flight.append(self._ball.position.clone())
        return delayed(torch.stack(flight, dim=1), values["delay"])

    def apex(self, cube: Tensor) -> Tensor:
        """Apex (M, 3) m after the bounce, NaN if there is none, for points (M, D)."""
        self._launch(cube)
        ball = self._ball
        ball.forecast(self._everyone, ball.position, ball.velocity, ball.spin, self.config.reward.target_x)
        return ball.forecast_result.apex.clone()

    def served(self, cube: Tensor) -> Tensor:
        """(M,) bool: points (M, D) whose serves are played, since they land as ``serve.attempts`` asks for; all without
        it."""
        limits = self.config.serve.limits()
        if self.config.serve.attempts == 1:
            return torch.ones(len(cube), dtype=torch.bool)
        self._launch(cube)
        ball = self._ball
        ball.forecast(self._everyone, ball.position, ball.velocity, ball.spin, self.config.reward.target_x)
        flight = ball.forecast_result
        limited = {"speed": ball.velocity.norm(dim=1), "bounce_x": flight.bounce[:, 0], "bounce_y": flight.bounce[:, 1]}
        found = flight.landing_own & ~flight.net_touched
        for name, (low, high) in limits.items():
            found &= (limited[name] >= low) & (limited[name] <= high)
        return found

    def _launch(self, cube: Tensor) -> dict[str, Tensor]:
        values, ball = self.prior.values(cube), self._ball
        for name, start in (("position", ball.position), ("velocity", ball.velocity)):
            start.copy_(torch.stack([values[f"{name}_{axis}"] for axis in AXES], dim=1))
        ball.spin.copy_(world_spin(torch.stack([values[name] for name in SPINS], dim=1), ball.velocity))
        for name in SAMPLED_BALL_PARAMS:
            if name in values:
                getattr(ball.params, name).copy_(values[name])
        return values


def delayed(flight: Tensor, delay: Tensor) -> Tensor:
    """Positions (M, T, 3) delayed by ``delay`` (M,) control steps, linear between frames; the first has no past."""
    whole = delay.floor()
    share = (delay - whole).view(-1, 1, 1)
    now = torch.arange(flight.shape[1]) - whole.long().unsqueeze(1)
    newer, older = (flight.gather(1, at.clamp(min=0).unsqueeze(-1).expand_as(flight)) for at in (now, now - 1))
    return (1.0 - share) * newer + share * older


@dataclass(frozen=True)
class Recording:
    """N serves of the task over T control steps from their launch, from :class:`ServePractice`."""

    cube: Tensor  # (N, D), the samples
    sensed: Tensor  # (N, T, 3) m
    predicted: Tensor  # (N, T, 3) m, predicted apex; NaN without a predictor
    apex: Tensor  # (N, 3) m
    time_to_apex: Tensor  # (N, T) s
    valid: Tensor  # (N, T) bool, there is something to hit


@torch.no_grad()
def record(config: TrainConfig, frames: int, predictor: nn.Module | None = None) -> Recording:
    """Play ``config.num_worlds`` serves for ``frames`` control steps; ``predictor`` predicts at each.

    The same seed gives the same serves to every predictor.
    """
    practice = ServePractice(config, torch.device("cpu"))
    cube, apex = ServePrior(config).cube(_drawn(practice)), practice.predictor_target[:, :3].clone()
    first = torch.ones(config.num_worlds, dtype=torch.bool)
    nothing = torch.full((config.num_worlds, 3), torch.nan)
    seen: list[tuple[Tensor, ...]] = []
    for t in range(frames):
        if t > 0:
            practice.advance()
            first &= ~practice.serve_over
        predicted = nothing if predictor is None else predictor(practice.predictor_input)[:, :3]
        valid = practice.predictor_valid & first
        sensed, left = practice.sensing.ball_position, practice.predictor_time_to_apex
        seen.append((sensed.clone(), predicted, left.clone(), valid))
    sensed, predicted, left, valid = (torch.stack(part, dim=1) for part in zip(*seen, strict=True))
    return Recording(cube, sensed, predicted, apex, left, valid)


def _drawn(practice: ServePractice) -> dict[str, Tensor]:
    """The samples of the serves that have just begun, by the names of :class:`ServePrior`."""
    ball = practice.ball
    launch = {"position": ball.position, "velocity": ball.velocity}
    sampled = {f"{name}_{axis}": value[:, i].clone() for name, value in launch.items() for i, axis in enumerate(AXES)}
    sampled |= {name: practice.serves.about[:, i].clone() for i, name in enumerate(SPINS)}
    sampled |= {name: getattr(ball.params, name).clone() for name in SAMPLED_BALL_PARAMS}
    return sampled | {"delay": practice.sensing.delay.clone()}
