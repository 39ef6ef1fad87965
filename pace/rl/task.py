"""Table tennis as a task: serves, the referee, and what the ball's forecast asks of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pace.config import ResetConfig, RewardConfig, RobotConfig, ServeConfig
from pace.sim.snapshot import restore, snapshot

if TYPE_CHECKING:
    from pace.sim.ball import BallEvents, Forecast


class Outcome(IntEnum):
    """How a serve ended. All but ``OPEN`` and ``BAD_SERVE`` count in the rates."""

    OPEN = 0  # not decided yet
    SUCCESS = 1  # hit, then landed first on the opponent's half
    MISS = 2  # the ball passed, fell or bounced twice before a hit
    NET = 3  # hit, touched the net and did not get over
    OUT = 4  # hit, then landed beside or beyond the table
    OWN_SIDE = 5  # hit, then bounced on the own half
    DOUBLE_HIT = 6  # a second paddle contact before the ball landed
    VOLLEY = 7  # paddle contact before the bounce on the own half
    FALL = 8  # the robot fell or left its area before the serve was decided
    BAD_SERVE = 9  # the serve never bounces on the robot's half: not the robot's fault


def uniform(generator: torch.Generator, low: Tensor, high: Tensor, num_worlds: int) -> Tensor:
    """Samples (N, C) between rows ``low`` and ``high`` (C,)."""
    sample = torch.rand(num_worlds, low.shape[0], device=low.device, generator=generator)
    return sample.mul_(high - low).add_(low)


def bounds(ranges: list[list[float]], device: torch.device) -> tuple[Tensor, Tensor]:
    """Lower and upper row (C,) of C ranges."""
    table = torch.tensor(ranges, dtype=torch.float32, device=device)
    return table[:, 0].contiguous(), table[:, 1].contiguous()


class ServeSampler:
    """Draws where serves start and how fast they are."""

    def __init__(self, config: ServeConfig, generator: torch.Generator, device: torch.device) -> None:
        ranges = [config.x, config.y, config.z, config.vx, config.vy, config.vz, config.spin, config.spin, config.spin]
        self._low, self._high = bounds(ranges, device)
        self._generator = generator

    def sample(self, num_worlds: int) -> tuple[Tensor, Tensor, Tensor]:
        """Position m, velocity m/s and spin rad/s, each (N, 3), world frame."""
        position, velocity, spin = uniform(self._generator, self._low, self._high, num_worlds).split(3, dim=1)
        return position, velocity, spin


class PoseSampler:
    """Draws the state in which a robot starts an episode."""

    def __init__(
        self,
        config: ResetConfig,
        robot: RobotConfig,
        nominal: Tensor,
        limits: tuple[Tensor, Tensor],
        joint_names: tuple[str, ...],
        generator: torch.Generator,
    ) -> None:
        self._generator = generator
        self._nominal = nominal
        self._limits = limits
        self._height = robot.base_height
        ranges = [config.base_x, config.base_y, config.yaw, *[config.linear_velocity] * 3]
        ranges += [config.roll_pitch_rate, config.roll_pitch_rate, config.yaw_rate]
        right_arm = [name.startswith("Right") and ("Shoulder" in name or "Elbow" in name) for name in joint_names]
        ranges += [config.right_arm_offset if right else config.joint_scale for right in right_arm]
        self._low, self._high = bounds(ranges, nominal.device)
        self._right_arm = torch.tensor(right_arm, device=nominal.device)

    def sample(self, num_worlds: int) -> tuple[Tensor, Tensor]:
        """qpos (N, 7 + J) and qvel (N, 6 + J) of MuJoCo; joints within their limits and at rest."""
        sample = uniform(self._generator, self._low, self._high, num_worlds)
        joints = self._nominal.shape[0]
        qpos, qvel = sample.new_zeros(num_worlds, 7 + joints), sample.new_zeros(num_worlds, 6 + joints)
        qpos[:, :2] = sample[:, :2]
        qpos[:, 2] = self._height
        half_yaw = 0.5 * sample[:, 2]
        qpos[:, 3], qpos[:, 6] = torch.cos(half_yaw), torch.sin(half_yaw)
        qvel[:, :6] = sample[:, 3:9]
        drawn = sample[:, 9:]
        pose = torch.where(self._right_arm, self._nominal + drawn, self._nominal * drawn)
        qpos[:, 7:] = pose.clamp(*self._limits)
        return qpos, qvel


class Referee:
    """Knows the rules. Consumes the events of each control step in the order of their times.

    A hit is physical contact after exactly one bounce on the own half; a valid return then lands first on the
    opponent's half (it may touch the net on the way). What is decided stays decided until the next serve.
    Events of one kind after its first within a control step have no time of their own; they are taken to follow the
    contact at once, which is exact unless a ball meets the table twice and the paddle within 20 ms.

    Attributes, all (N,): ``own_bounces`` int, ``hit`` bool (legal), ``touched`` bool (any paddle contact), ``rim``,
    ``net_touched`` bool (after the hit), ``touch_time`` s on the serve clock (inf before), ``outcome`` int; of this
    step: ``was_open``, ``hit_now``, ``success_now`` bool.
    """

    def __init__(self, num_worlds: int, device: torch.device) -> None:
        def flags() -> Tensor:
            return torch.zeros(num_worlds, dtype=torch.bool, device=device)

        self.own_bounces = torch.zeros(num_worlds, dtype=torch.int32, device=device)
        self.outcome = torch.full((num_worlds,), Outcome.BAD_SERVE, dtype=torch.int32, device=device)
        self.touch_time = torch.full((num_worlds,), torch.inf, device=device)
        self.hit, self.touched, self.rim, self.net_touched = flags(), flags(), flags(), flags()
        self.was_open, self.hit_now, self.success_now = flags(), flags(), flags()

    @property
    def is_open(self) -> Tensor:
        """Whether the serve is undecided (N,) bool."""
        return self.outcome == Outcome.OPEN

    def start(self, mask: Tensor, playable: Tensor) -> None:
        """Begin a serve in the worlds of ``mask`` (N,); ``playable`` (N,): the serve will bounce on the own half."""
        self.own_bounces.masked_fill_(mask, 0)
        self.touch_time.masked_fill_(mask, torch.inf)
        for flag in (self.hit, self.touched, self.rim, self.net_touched):
            flag.masked_fill_(mask, False)
        self.outcome.masked_fill_(mask & playable, Outcome.OPEN)
        self.outcome.masked_fill_(mask & ~playable, Outcome.BAD_SERVE)

    def judge(self, events: BallEvents, step_start: Tensor, ball_x: Tensor) -> None:
        """Consume the events of one control step that began at ``step_start`` (N,) s; ``ball_x`` (N,) m at its end."""
        torch.eq(self.outcome, Outcome.OPEN, out=self.was_open)
        struck = events.paddle_hit > 0
        bounce_first = events.own_bounce_time < events.paddle_hit_time
        before = self.own_bounces + torch.where(struck, bounce_first.int(), events.own_bounce)
        dead = torch.minimum(events.floor_time, events.edge_time)
        lost = (before >= 2) | (dead < events.paddle_hit_time)
        waiting = self.was_open & ~self.hit
        in_play = waiting & struck & ~lost
        torch.logical_and(in_play, before == 1, out=self.hit_now)
        volley = in_play & (before == 0)
        flight = self._judge_flight(events, bounce_first, dead, ball_x)
        self.hit |= self.hit_now
        self.outcome.copy_(torch.where(self.was_open & self.hit, flight, self.outcome))
        self.outcome.masked_fill_(volley, Outcome.VOLLEY)
        self.outcome.masked_fill_(waiting & lost, Outcome.MISS)
        self.own_bounces += events.own_bounce
        self.rim |= self.hit_now & (events.hit_rim > 0)
        first_touch = step_start + events.paddle_hit_time
        self.touch_time.copy_(torch.where(self.touched, self.touch_time, first_touch))
        self.touched |= struck

    def _judge_flight(self, events: BallEvents, bounce_first: Tensor, dead: Tensor, ball_x: Tensor) -> Tensor:
        """Outcome (N,) of balls in flight after a legal hit: ``OPEN`` while nothing has happened to them.

        ``dead`` (N,) s: when the ball met the floor or the table's sides or underside, which are not playing surface.
        """
        since = torch.where(self.hit, -1.0, torch.where(self.hit_now, events.paddle_hit_time, torch.inf))
        own_count = events.own_bounce - (self.hit_now & bounce_first).int()
        own = torch.where(own_count > 0, torch.maximum(events.own_bounce_time, since), torch.inf)
        second_touch = events.paddle_hit - self.hit_now.int() > 0
        again = torch.where(second_touch, torch.maximum(events.paddle_hit_time, since), torch.inf)
        opponent = _after(events.opponent_bounce_time, since)
        off_table = _after(dead, since)
        first, kind = torch.stack((opponent, own, off_table, again)).min(0)
        net = _after(events.net_time, since)
        self.net_touched |= (net <= first) & net.isfinite()
        outcome = landed(kind == 0, kind == 1, self.net_touched, ball_x)
        outcome = torch.where(kind == 3, int(Outcome.DOUBLE_HIT), outcome)
        return torch.where(first.isfinite(), outcome, int(Outcome.OPEN)).int()

    def close(self, over: Tensor, fallen: Tensor, returns: ReturnForecast) -> None:
        """Decide the serves that end now. All masks (N,) bool.

        Args:
            over: the serve ends. A flight that the clock cuts off is decided by its forecast; without a hit it is
                a miss.
            fallen: the robot fell, or left its area.
            returns: forecast of the flight after the hit.
        """
        is_open = self.is_open
        cut_off = landed(returns.lands_opponent, returns.lands_own, self.net_touched, returns.landing[:, 0])
        decided = torch.where(self.hit, cut_off, int(Outcome.MISS))
        self.outcome.copy_(torch.where(is_open & over, decided, self.outcome))
        self.outcome.masked_fill_(is_open & fallen, Outcome.FALL)
        torch.logical_and(self.was_open, self.outcome == Outcome.SUCCESS, out=self.success_now)


def _after(time: Tensor, since: Tensor) -> Tensor:
    return torch.where(time > since, time, torch.inf)


def landed(on_opponent: Tensor, on_own: Tensor, net_touched: Tensor, x: Tensor) -> Tensor:
    """Outcome (N,) of a hit ball by where it lands first; off the table it is out, or caught by the net."""
    caught = net_touched & (on_own | (x < 0.0))
    fault = torch.where(on_own, int(Outcome.OWN_SIDE), int(Outcome.OUT))
    fault = torch.where(caught, int(Outcome.NET), fault)
    return torch.where(on_opponent, int(Outcome.SUCCESS), fault).int()


class Target:
    """Where and when the paddle should meet the ball: from the forecast of the serve. World frame, serve clock.

    Attributes: ``playable`` (N,) bool, ``apex`` (N, 3) m, ``apex_time`` (N,) s, ``point`` (N, 3) m the paddle's
    target, ``time`` (N,) s when the ball is there; ``idle_point`` (3,) m: a target to stand by while there is nothing
    to hit, the one that belongs to the idle base position.
    """

    def __init__(self, config: RewardConfig, num_worlds: int, device: torch.device) -> None:
        self._intercept = config.target_mode == "intercept"
        self._x = config.target_x
        idle_xy = [base - arm for base, arm in zip(config.idle_base_xy, config.arm_offset, strict=True)]
        self.idle_point = torch.tensor([*idle_xy, config.idle_height], device=device)
        self.playable = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self.apex = self.idle_point.repeat(num_worlds, 1)
        self.point = self.idle_point.repeat(num_worlds, 1)
        self.apex_time = torch.zeros(num_worlds, device=device)
        self.time = torch.zeros(num_worlds, device=device)

    def aim(self, mask: Tensor, forecast: Forecast) -> None:
        """Take the forecast of the serves that begin in the worlds of ``mask`` (N,) bool."""
        playable = forecast.bounce_time.isfinite() & forecast.apex_time.isfinite()
        apex = torch.where(playable.unsqueeze(-1), forecast.apex, self.idle_point)
        apex_time = torch.where(playable, forecast.apex_time, 0.0)
        point, time = self._paddle_target(apex, apex_time, forecast)
        wide = mask.unsqueeze(-1)
        self.playable.copy_(torch.where(mask, playable, self.playable))
        self.apex.copy_(torch.where(wide, apex, self.apex))
        self.point.copy_(torch.where(wide, point, self.point))
        self.apex_time.copy_(torch.where(mask, apex_time, self.apex_time))
        self.time.copy_(torch.where(mask, time, self.time))

    def _paddle_target(self, apex: Tensor, apex_time: Tensor, forecast: Forecast) -> tuple[Tensor, Tensor]:
        if self._intercept:
            reached = forecast.intercept_time.isfinite()
            point = torch.where(reached.unsqueeze(-1), forecast.intercept, apex)
            return point, torch.where(reached, forecast.intercept_time, apex_time)
        return clamp_x(apex, self._x), apex_time


def clamp_x(point: Tensor, largest: float) -> Tensor:
    """``point`` (N, 3) with its x at most ``largest``."""
    return torch.cat((point[:, :1].clamp(max=largest), point[:, 1:]), dim=1)


class ReturnForecast:
    """Forecast of the flight after a hit, kept until the next one.

    Attributes: ``landing`` (N, 3) m first contact with table or floor, ``net_height`` (N,) m above the floor when it
    crosses the net towards +x, ``lands_own``, ``lands_opponent`` (N,) bool; NaN where there is none.
    """

    def __init__(self, num_worlds: int, device: torch.device) -> None:
        self.landing = torch.full((num_worlds, 3), torch.nan, device=device)
        self.net_height = torch.full((num_worlds,), torch.nan, device=device)
        self.lands_own = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self.lands_opponent = torch.zeros(num_worlds, dtype=torch.bool, device=device)

    def take(self, mask: Tensor, forecast: Forecast) -> None:
        """Take the forecast of the balls that were hit in the worlds of ``mask`` (N,) bool."""
        self.landing.copy_(torch.where(mask.unsqueeze(-1), forecast.landing, self.landing))
        self.net_height.copy_(torch.where(mask, forecast.net_height, self.net_height))
        self.lands_own.copy_(torch.where(mask, forecast.landing_own > 0, self.lands_own))
        self.lands_opponent.copy_(torch.where(mask, forecast.landing_opponent > 0, self.lands_opponent))


def nothing_to_hit(position: Tensor, velocity: Tensor, rule: Mapping[str, float]) -> Tensor:
    """Whether a ball at ``position`` (N, 3) m with ``velocity`` (N, 3) m/s cannot be hit any more: (N,) bool.

    It is past ``past_x``, moves away, is below ``low_z``, or falls past ``falling_x`` (m, world frame).
    """
    x, _, z = position.unbind(1)
    gone = (x < rule["past_x"]) | (velocity[:, 0] > 0.0) | (z < rule["low_z"])
    return gone | ((x < rule["falling_x"]) & (velocity[:, 2] < 0.0))


class Closeness:
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

    def start(self, mask: Tensor) -> None:
        """Begin a serve in the worlds of ``mask`` (N,)."""
        self.nearest.masked_fill_(mask, torch.inf)
        self.previous.masked_fill_(mask, torch.inf)
        self.arrived.masked_fill_(mask, False)

    def update(self, referee: Referee, distance: Tensor, due: Tensor) -> None:
        """Take this step's ``distance`` (N,) m; ``due`` (N,) bool: the target time has come."""
        playable = referee.was_open & (referee.own_bounces >= 1) & (referee.hit_now | ~referee.touched)
        self.previous.copy_(self.nearest)
        torch.where(playable, torch.minimum(self.nearest, distance), self.nearest, out=self.nearest)
        torch.logical_and(playable & (due | referee.hit_now), ~self.arrived, out=self.arrived_now)
        self.arrived |= self.arrived_now


class ServeClock:
    """Counts serves and their time.

    Attributes (N,): ``time`` s since the serve began, ``index`` number of the serve in its episode, ``played`` serves
    finished since the world was made.
    """

    def __init__(self, config: ServeConfig, num_worlds: int, device: torch.device) -> None:
        self._config = config
        self.time = torch.zeros(num_worlds, device=device)
        self.index = torch.zeros(num_worlds, device=device)
        self.played = torch.zeros(num_worlds, device=device)
        self.fresh = torch.ones(num_worlds, dtype=torch.bool, device=device)

    def start_episode(self, mask: Tensor, generator: torch.Generator) -> None:
        """First serve of an episode; a world's first episode may begin at a random serve, so that ends spread out."""
        count = self._config.serves_per_episode
        first = torch.rand(self.index.shape, device=self.index.device, generator=generator).mul_(count).floor_()
        random = self.fresh & (self._config.random_phase and count > 0)
        self.index.copy_(torch.where(mask, torch.where(random, first, 0.0), self.index))
        self.fresh &= ~mask

    def over(self, ball_z: Tensor, floor: Tensor, touch_time: Tensor) -> Tensor:
        """Which serves end now (N,) bool: ball low or on the floor, time up, or long enough after the contact."""
        low = (ball_z < self._config.end_height) | (floor > 0)
        over = low | (self.time >= self._config.max_duration)
        if self._config.end_after_hit > 0.0:
            over |= self.time >= touch_time + self._config.end_after_hit
        return over

    def finish(self, over: Tensor) -> None:
        """Count the serves that ended (N,) bool."""
        self.index += over
        self.played += over

    def last_serve(self) -> Tensor:
        """Whether the current serve is the last of its episode (N,) bool."""
        if self._config.serves_per_episode == 0:
            return torch.zeros_like(self.fresh)
        return self.index + 1 >= self._config.serves_per_episode

    @property
    def serve_progress(self) -> Tensor:
        """Share of the longest serve (N,)."""
        return self.time / self._config.max_duration

    @property
    def episode_progress(self) -> Tensor:
        """Share of the episode's serves (N,), 0 where episodes do not end."""
        if self._config.serves_per_episode == 0:
            return torch.zeros_like(self.time)
        return ((self.index + self.serve_progress) / self._config.serves_per_episode).clamp(max=1.0)


def lost_position(base_position: Tensor, config: ResetConfig) -> Tensor:
    """Whether the robot has fallen or left its area (N,) bool, from the base position (N, 3) m."""
    x, y, z = base_position.unbind(1)
    outside_x = (x < config.bounds_x[0]) | (x > config.bounds_x[1])
    return (z < config.min_base_height) | outside_x | (y < config.bounds_y[0]) | (y > config.bounds_y[1])


class Game:
    """Everything that the rules and the ball's forecast say about N worlds, by part, for saving and resuming."""

    def __init__(self, serve: ServeConfig, reward: RewardConfig, num_worlds: int, device: torch.device) -> None:
        self.clock = ServeClock(serve, num_worlds, device)
        self.referee = Referee(num_worlds, device)
        self.target = Target(reward, num_worlds, device)
        self.returns = ReturnForecast(num_worlds, device)
        self.closeness = Closeness(num_worlds, device)

    def start_serve(self, mask: Tensor, forecast: Forecast) -> None:
        """Begin the serve whose flight was forecast, in the worlds of ``mask`` (N,) bool."""
        self.clock.time.masked_fill_(mask, 0.0)
        self.target.aim(mask, forecast)
        self.referee.start(mask, self.target.playable)
        self.closeness.start(mask)

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of all tensors, by part and name."""
        return {f"{part}.{name}": value for part in vars(self) for name, value in snapshot(getattr(self, part)).items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Put back what :meth:`state_dict` returned."""
        for part, owner in vars(self).items():
            prefix = f"{part}."
            restore(owner, {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
