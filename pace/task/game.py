"""Table tennis as a task: serves, the referee, and what the ball's forecast asks of the robot.

The rules themselves are the kernels of :mod:`pace.task.game_kernels`; here are their tensors and their order.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pace.arrays.share import record, share, share_all
from pace.arrays.state import restore, snapshot, under_prefix, with_prefix
from pace.config.task import RewardConfig, ServeConfig, TaskConfig
from pace.onboard.prediction import idle_point
from pace.sim.ball.kernels import EventArrays, ForecastArrays
from pace.task import game_kernels
from pace.task.game_kernels import GameArrays, Rules
from pace.task.outcome import Outcome

if TYPE_CHECKING:
    from pace.sim.ball.ball import BallSim

__all__ = ["Game", "Outcome"]


class Part:
    """Tensors of a :class:`Game` that belong together."""

    def tensors(self) -> dict[str, Tensor]:
        """The tensors themselves, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}


class Referee(Part):
    """What the referee knows of each serve.

    A hit is physical contact after exactly one bounce on the own half; a valid return then lands first on the
    opponent's half (it may touch the net on the way). What is decided stays decided until the next serve.
    Events of one kind after its first within a control step have no time of their own; they are taken to follow the
    contact at once, which is exact unless a ball meets the table twice and the paddle within 20 ms.

    Attributes, all (N,): ``own_bounces`` int, ``hit`` bool (legal), ``touched`` bool (any paddle contact), ``rim``,
    ``net_touched`` bool (after the hit), ``touch_time`` s on the serve clock (inf before), ``outcome`` int
    (:class:`Outcome`); of the last step: ``was_open`` before it, ``hit_now``, ``success_now`` bool.
    """

    def __init__(self, num_worlds: int, device: torch.device) -> None:
        self.own_bounces = torch.zeros(num_worlds, dtype=torch.int32, device=device)
        self.outcome = torch.full((num_worlds,), int(Outcome.BAD_SERVE), dtype=torch.int32, device=device)
        self.touch_time = torch.full((num_worlds,), torch.inf, device=device)
        flags = torch.zeros(7, num_worlds, dtype=torch.bool, device=device)
        self.hit, self.touched, self.rim, self.net_touched = (flag.clone() for flag in flags[:4])
        self.was_open, self.hit_now, self.success_now = (flag.clone() for flag in flags[4:])


class Target(Part):
    """Where and when the paddle should meet the ball: from the forecast of the serve. World frame, serve clock.

    Attributes: ``playable`` (N,) bool, ``apex`` (N, 3) m, ``apex_time`` (N,) s, ``point`` (N, 3) m the paddle's
    target, ``time`` (N,) s when the ball is there, ``arriving`` (N, 3) m/s its velocity at the later of the apex and
    ``reward.target_x``; ``something_to_hit`` (N,) bool, the ball can still be hit legally;
    ``idle_point`` (3,) m: a target to stand by while there is nothing to hit, the one that belongs to the idle base
    position.
    """

    def __init__(self, config: RewardConfig, num_worlds: int, device: torch.device) -> None:
        self.idle_point = torch.tensor(idle_point(config), device=device)
        self.playable = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self.something_to_hit = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self.apex = self.idle_point.repeat(num_worlds, 1)
        self.point = self.idle_point.repeat(num_worlds, 1)
        self.arriving = torch.zeros(num_worlds, 3, device=device)
        self.apex_time = torch.zeros(num_worlds, device=device)
        self.time = torch.zeros(num_worlds, device=device)


class ReturnForecast(Part):
    """Forecast of the flight after a hit, kept until the next one.

    Attributes: ``landing`` (N, 3) m first contact with table or floor, ``net_height`` (N,) m above the floor when it
    crosses the net towards +x, ``lands_own``, ``lands_opponent`` (N,) bool; NaN where there is none.
    """

    def __init__(self, num_worlds: int, device: torch.device) -> None:
        self.landing = torch.full((num_worlds, 3), torch.nan, device=device)
        self.net_height = torch.full((num_worlds,), torch.nan, device=device)
        self.lands_own = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self.lands_opponent = torch.zeros(num_worlds, dtype=torch.bool, device=device)


class Closeness(Part):
    """How near the paddle came to the ball while it could be hit legally, over each serve.

    Attributes (N,): ``nearest`` m, smallest distance from the face centre to the ball's surface so far (inf at the
    start); ``previous`` m, the same a control step ago; ``arrived`` bool, the ball was hit or is past its target time;
    ``arrived_now`` bool, since this step.
    """

    def __init__(self, num_worlds: int, device: torch.device) -> None:
        self.nearest = torch.full((num_worlds,), torch.inf, device=device)
        self.previous = torch.full((num_worlds,), torch.inf, device=device)
        self.arrived = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self.arrived_now = torch.zeros(num_worlds, dtype=torch.bool, device=device)


class ServeClock(Part):
    """Counts serves and their time.

    Attributes (N,): ``time`` s since the serve began, ``index`` number of the serve in its episode, ``played`` serves
    finished since the world was made, ``fresh`` bool: the world has not been reset yet.
    """

    def __init__(self, config: ServeConfig, num_worlds: int, device: torch.device) -> None:
        self.time = torch.zeros(num_worlds, device=device)
        self.index = torch.zeros(num_worlds, device=device)
        self.played = torch.zeros(num_worlds, device=device)
        self.fresh = torch.ones(num_worlds, dtype=torch.bool, device=device)
        self._mask = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self._seed = torch.zeros(1, dtype=torch.int32, device=device)
        serves = config.serves_per_episode if config.random_phase else 0
        inputs = [share(self._mask), share(self._seed), serves, share(self.fresh), share(self.index)]
        self._start = record(game_kernels.start_episode, num_worlds, inputs, device)

    def start_episode(self, mask: Tensor, generator: torch.Generator) -> None:
        """First serve of an episode; a world's first episode may begin at a random serve, so that ends spread out."""
        self._mask.copy_(mask)
        self._seed.random_(generator=generator)
        self._start()

    def finish(self, over: Tensor) -> None:
        """Count the serves that ended (N,) bool."""
        self.index += over
        self.played += over


class StepEnds(Part):
    """What ended in the last control step.

    Attributes (N,): ``lost`` bool, the robot fell or left its area; ``over`` bool, the serve ended; ``next_serve``
    bool, and another one follows; ``truncated`` bool, it was the episode's last; ``outcome`` int and ``hit`` bool of
    the present serve, also after the next one has begun.
    """

    def __init__(self, num_worlds: int, device: torch.device) -> None:
        flags = torch.zeros(5, num_worlds, dtype=torch.bool, device=device)
        self.lost, self.over, self.next_serve, self.truncated, self.hit = (flag.clone() for flag in flags)
        self.outcome = torch.zeros(num_worlds, dtype=torch.int32, device=device)


def rules_of(config: TaskConfig) -> Rules:
    """The numbers of the configuration that the kernels need."""
    serve, reset, reward = config.serve, config.reset, config.reward
    rules = Rules()
    rules.control_dt = config.robot.control_dt
    rules.max_duration, rules.end_after_hit = serve.max_duration, serve.end_after_hit
    rules.end_height, rules.serves_per_episode = serve.end_height, serve.serves_per_episode
    rules.min_base_height, rules.bounds_x, rules.bounds_y = reset.min_base_height, reset.bounds_x, reset.bounds_y
    rules.intercept, rules.target_x = int(reward.target_mode == "intercept"), reward.target_x
    rules.arm_offset, rules.idle_base, rules.idle_point = reward.arm_offset, reward.idle_base_xy, idle_point(reward)
    for name in ("past_x", "low_z", "falling_x"):
        setattr(rules, name, reward.nothing_to_hit[name])
    return rules


class Game:
    """Everything that the rules and the ball's forecast say about N worlds.

    In each control step: :meth:`judge`, a forecast of the balls of ``referee.hit_now``, :meth:`close`; then
    :meth:`start_serve` after the forecast of new serves.

    Args:
        config: the task.
        ball: the balls that are played; their tensors are read by each call.
        base_position: (N, 3) m, of the robots; read by :meth:`close`.
    """

    def __init__(self, config: TaskConfig, ball: BallSim, base_position: Tensor) -> None:
        count, device = ball.num_worlds, ball.device
        self.clock = ServeClock(config.serve, count, device)
        self.referee = Referee(count, device)
        self.target = Target(config.reward, count, device)
        self.returns = ReturnForecast(count, device)
        self.closeness = Closeness(count, device)
        self.ends = StepEnds(count, device)
        self.rules = rules_of(config)
        self._mask = torch.zeros(count, dtype=torch.bool, device=device)
        self._record(ball, base_position)

    def _parts(self) -> Iterator[tuple[str, Part]]:
        return ((name, part) for name, part in vars(self).items() if isinstance(part, Part))

    def arrays(self) -> GameArrays:
        """All tensors as the kernels see them."""
        tensors = {name: value for _, part in self._parts() for name, value in part.tensors().items()}
        tensors |= {"time": self.clock.time, "target_time": self.target.time}
        tensors |= {"hit": self.referee.hit, "outcome": self.referee.outcome}
        tensors |= {"ended_hit": self.ends.hit, "ended_outcome": self.ends.outcome}
        return share_all(GameArrays, tensors)

    def _record(self, ball: BallSim, base_position: Tensor) -> None:
        count, device = ball.num_worlds, ball.device
        game = self.arrays()
        events = share_all(EventArrays, vars(ball.events))
        forecast = share_all(ForecastArrays, vars(ball.forecast_result))
        position, velocity = share(ball.position), share(ball.velocity)
        self._judge = record(game_kernels.judge, count, [game, events, position], device)
        radius = torch.as_tensor(ball.params.radius)  # shares the memory of the per-world tensor that it is
        distances = [share(ball.nearest_paddle_distance), share(radius)]
        inputs = [game, events, forecast, position, velocity, *distances, share(base_position), self.rules]
        self._close = record(game_kernels.close, count, inputs, device)
        inputs = [share(self._mask), game, forecast, position, velocity, share(self.target.arriving), self.rules]
        self._start = record(game_kernels.start_serve, count, inputs, device)

    def judge(self) -> None:
        """The referee consumes the events of the control step."""
        self._judge()

    def close(self) -> None:
        """Clock, forecasts of hits, ends: a serve that is cut off in flight is decided by its forecast; one that ends
        without a hit is a miss, and a fall decides an open serve.
        """
        self._close()

    def start_serve(self, mask: Tensor) -> None:
        """Begin the serve whose flight was forecast, in the worlds of ``mask`` (N,) bool."""
        self._mask.copy_(mask)
        self._start()

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of all tensors, by part and name."""
        state: dict[str, Tensor] = {}
        for name, part in self._parts():
            state |= with_prefix(name, snapshot(part))
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Put back what :meth:`state_dict` returned."""
        for name, part in self._parts():
            restore(part, under_prefix(name, state))
