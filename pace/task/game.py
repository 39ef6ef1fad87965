"""Table tennis as a task: serves, the referee, and the robot's targets from the ball's forecast.

The kernels are in :mod:`pace.task.referee` and :mod:`pace.task.game_kernels`; this module has their tensors and their
order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pace.arrays.launch import Launch, MaskedLaunch
from pace.arrays.state import Stateful
from pace.arrays.tensors import allocate, named_tensors
from pace.config.task import ServeConfig, TaskConfig
from pace.onboard.prediction import idle_point
from pace.task import game_kernels, referee
from pace.task.game_state import GameState
from pace.task.outcome import Outcome
from pace.task.rules import Rules

if TYPE_CHECKING:
    from pace.sim.ball.ball import BallSim

__all__ = ["Game", "Outcome"]


def rules_of(config: TaskConfig) -> Rules:
    """The kernels' numbers from the configuration."""
    serve, reset, reward = config.serve, config.reset, config.reward
    rules = Rules()
    rules.control_dt = config.robot.control_dt
    rules.max_duration, rules.end_after_hit = serve.max_duration, serve.end_after_hit
    rules.end_height, rules.serves_per_episode = serve.end_height, serve.serves_per_episode
    rules.min_base_height, rules.bounds_x, rules.bounds_y = reset.min_base_height, reset.bounds_x, reset.bounds_y
    rules.intercept, rules.target_x = int(reward.target_mode == "intercept"), reward.target_x
    rules.table_push = config.ball.table.push_force
    rules.arm_offset, rules.idle_base, rules.idle_point = reward.arm_offset, reward.idle_base_xy, idle_point(reward)
    for name in ("past_x", "low_z", "falling_x"):
        setattr(rules, name, reward.nothing_to_hit[name])
    return rules


class Game(GameState, Stateful):
    """Rules and ball forecast of N worlds.

    In each control step: :meth:`judge`, a forecast of the balls of ``referee.hit_now``, :meth:`close`; then
    :meth:`start_serve` after the forecast of new serves.

    Args:
        config: the task.
        ball: the balls that are played; their tensors are read by each call.
        base_position: (N, 3) m, of the robots; read by :meth:`close`.
        table_force: (N, S, T, 3) N, of the tables on the robots (:class:`pace.sim.engine.base.RobotEngine`); ``None``:
            nobody touches it.
    """

    def __init__(
        self, config: TaskConfig, ball: BallSim, base_position: Tensor, table_force: Tensor | None = None
    ) -> None:
        count, device = ball.num_worlds, ball.device
        super().__init__(**vars(allocate(GameState, count, device)))
        self.landing_target = (config.landing_target[0], config.landing_target[1])
        self.rules = rules_of(config)
        self.idle_point = torch.tensor(idle_point(config.reward), device=device)
        for goal in (self.target.apex, self.target.point):
            goal.copy_(self.idle_point.expand_as(goal))
        self._seed = torch.zeros(1, dtype=torch.int32, device=device)
        if table_force is None:
            table_force = torch.zeros(count, 1, 1, 3, device=device)
        self._judge = Launch(
            referee.judge,
            count,
            device,
            game=self,
            events=ball.events,
            ball=ball,
            table_force=table_force,
            rules=self.rules,
        )
        self._record(config.serve, ball, base_position)

    def _record(self, config: ServeConfig, ball: BallSim, base_position: Tensor) -> None:
        count, device, forecast = ball.num_worlds, ball.device, ball.forecast_result
        given = {"game": self, "ball": ball, "forecast": forecast, "rules": self.rules}
        seen = {"events": ball.events, "paddle_distance": ball.nearest_paddle_distance}
        seen |= {"radius": ball.params.radius, "base_position": base_position}
        self._close = Launch(game_kernels.close, count, device, **given, **seen)
        self._start_serve = MaskedLaunch(game_kernels.start_serve, count, device, **given)
        serves = config.serves_per_episode if config.random_phase else 0
        sampled = {"seed": self._seed, "serves": serves, "fresh": self.clock.fresh, "index": self.clock.index}
        self._start_episode = MaskedLaunch(game_kernels.start_episode, count, device, **sampled)

    def judge(self) -> None:
        """The referee consumes the events of the control step."""
        self._judge()

    def close(self) -> None:
        """Update clock, forecasts of hits and ends. The forecast decides a serve that is cut off in flight; a serve
        that ends without a hit is a miss; a fall decides an open serve.
        """
        self._close()

    def count_serves(self) -> None:
        """Count the serves that ended in this step."""
        self.clock.index += self.ends.over
        self.clock.played += self.ends.over

    def start_serve(self, mask: Tensor) -> None:
        """Begin the serve whose flight was forecast, in the worlds of ``mask`` (N,) bool."""
        self._start_serve(mask)

    def start_episode(self, mask: Tensor, generator: torch.Generator) -> None:
        """First serve of an episode. A world's first episode may begin at a random serve, to desynchronise the ends."""
        self._seed.random_(generator=generator)
        self._start_episode(mask)

    def state_tensors(self) -> dict[str, Tensor]:
        """All tensors, by part and name; the idle point under its name in checkpoints."""
        return named_tensors(self) | {"target.idle_point": self.idle_point}
