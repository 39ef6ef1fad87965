"""Initial states of serves and robots: samplers over N worlds."""

from __future__ import annotations

import math

import torch
import warp as wp
from torch import Tensor

from pace.arrays.draws import Column, UniformSampler, columns_of
from pace.arrays.graph import may_look
from pace.arrays.launch import Launch, MaskedLaunch
from pace.arrays.state import Stateful
from pace.arrays.warm import rehearsing
from pace.config.base import ConfigError
from pace.config.sim import RobotConfig
from pace.config.task import ResetConfig, ServeConfig
from pace.sim.ball.ball import BallSim
from pace.sim.ball.state import BallState, ForecastArrays
from pace.sim.robot_spec import RobotSpec

#: Rounds in which every world must find a first serve that keeps the limits; with 1 of 20 accepted, 7e-12 do not.
FIRST_ATTEMPTS = 500


@wp.kernel
def turn(yaw: wp.array[wp.float32], qpos: wp.array2d[wp.float32]):
    """The quaternion of a robot that stands upright, turned by ``yaw`` rad."""
    world = wp.tid()
    qpos[world, 3] = wp.cos(0.5 * yaw[world])
    qpos[world, 6] = wp.sin(0.5 * yaw[world])


@wp.func
def _unit(vector: wp.vec3, otherwise: wp.vec3) -> wp.vec3:
    """``vector`` with length 1; ``otherwise`` if it has none."""
    length = wp.length(vector)
    if length > 0.0:
        return vector / length
    return otherwise


@wp.kernel
def spin_of(mask: wp.array[wp.bool], about: wp.array[wp.vec3], velocity: wp.array[wp.vec3], spin: wp.array[wp.vec3]):
    """Spin (rad/s, world frame) of the masked worlds from that ``about`` three axes: topspin, sidespin, corkscrew.

    Of a ball without horizontal velocity, the flight is taken to be towards the robot.
    """
    world = wp.tid()
    if not mask[world]:
        return
    flight = velocity[world]
    ahead = _unit(wp.vec3(flight[0], flight[1], 0.0), wp.vec3(-1.0, 0.0, 0.0))
    across = wp.vec3(-ahead[1], ahead[0], 0.0)  # z x ahead
    turns = about[world]
    spin[world] = turns[0] * across + wp.vec3(0.0, 0.0, turns[1]) + turns[2] * _unit(flight, ahead)


@wp.struct
class Limits:
    """Lowest and highest of each limited quantity of a serve; infinite if it has none."""

    speed: wp.vec2  # m/s
    bounce_x: wp.vec2  # m
    bounce_y: wp.vec2  # m


def _limits_of(config: ServeConfig) -> Limits:
    limits, given = Limits(), config.limits()
    for name in Limits.vars:
        setattr(limits, name, wp.vec2(*given.get(name, (-math.inf, math.inf))))
    return limits


@wp.func
def _within(value: float, limit: wp.vec2) -> bool:
    """NaN is within no limit."""
    return value >= limit[0] and value <= limit[1]


@wp.kernel
def reject(pending: wp.array[wp.bool], forecast: ForecastArrays, velocity: wp.array[wp.vec3], limits: Limits):
    """Leave those worlds ``pending`` whose serve does not land well, by its forecast."""
    world = wp.tid()
    if not pending[world]:
        return
    lands = forecast.landing_own[world] and not forecast.net_touched[world]
    bounce = forecast.bounce[world]
    lands = lands and _within(bounce[0], limits.bounce_x) and _within(bounce[1], limits.bounce_y)
    pending[world] = not (lands and _within(wp.length(velocity[world]), limits.speed))


@wp.kernel
def repeat_good(
    mask: wp.array[wp.bool],
    pending: wp.array[wp.bool],
    launch: wp.array2d[wp.float32],
    about: wp.array[wp.vec3],
    good: wp.array2d[wp.float32],
    good_about: wp.array[wp.vec3],
):
    """Keep the masked worlds' serves; those that are ``pending`` get their last good one instead."""
    world = wp.tid()
    if not mask[world]:
        return
    if pending[world]:
        about[world] = good_about[world]
    else:
        good_about[world] = about[world]
    for column in range(launch.shape[1]):
        if pending[world]:
            launch[world, column] = good[world, column]
        else:
            good[world, column] = launch[world, column]


def _spinning(about: Tensor, velocity: Tensor, spin: Tensor) -> MaskedLaunch:
    """:func:`spin_of` as a function of a mask."""
    return MaskedLaunch(spin_of, len(about), about.device, about=about, velocity=velocity, spin=spin)


def world_spin(about: Tensor, velocity: Tensor) -> Tensor:
    """Spin (N, 3) rad/s in the world frame from topspin, sidespin and corkscrew (N, 3) of balls at ``velocity``."""
    spin = torch.zeros_like(about)
    _spinning(about, velocity, spin)(None)
    return spin


class ServeSampler(Stateful):
    """Samples the initial position, velocity and spin of serves.

    With ``config.attempts`` above 1, serves that do not land well (:class:`pace.config.task.ServeConfig`) are sampled
    again, in that many rounds at most; their forecast overwrites that of ``ball`` in the masked worlds. The rounds are
    the same launches whatever is found, so that a CUDA graph can hold them; a CPU stops when no world is left. A world
    that found none in all rounds repeats its last good serve, which has the same distribution.

    Attributes: ``launch`` the last samples, as :meth:`sample` returns them; ``about`` (N, 3) rad/s, their topspin,
    sidespin and corkscrew.

    Errors: :class:`ConfigError` for limits that hardly any serve keeps.
    """

    STATE = ("sampled", "good", "good_about")

    def __init__(self, config: ServeConfig, ball: BallSim, generator: torch.Generator) -> None:
        num_worlds, device = ball.num_worlds, ball.device
        launch = self.sampled = torch.zeros(num_worlds, 9, device=device)
        self.launch = launch[:, :3], launch[:, 3:6], launch[:, 6:]
        self.about = torch.zeros(num_worlds, 3, device=device)
        ranges = [config.x, config.y, config.z, config.vx, config.vy, config.vz]
        spins = columns_of(self.about, [config.topspin, config.sidespin, config.corkscrew])
        self._sample = UniformSampler(columns_of(launch[:, :6], ranges) + spins, generator)
        self._spin = _spinning(self.about, *self.launch[1:])
        self._attempts = config.attempts
        self._pending = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self.good, self.good_about = torch.zeros_like(launch), torch.zeros_like(self.about)
        if self._attempts > 1:
            self._forecast = ball.forecaster(BallState(*self.launch), 0.0)
            given = {"forecast": ball.forecast_result, "velocity": self.launch[1], "limits": _limits_of(config)}
            self._reject = Launch(reject, num_worlds, device, pending=self._pending, **given)
            rows = {"launch": launch, "about": self.about, "good": self.good, "good_about": self.good_about}
            self._repeat = MaskedLaunch(repeat_good, num_worlds, device, pending=self._pending, **rows)
            self._find_good(config)

    def sample(self, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Position m, velocity m/s and spin rad/s, each (N, 3), world frame: new in the worlds of ``mask`` (N,) bool.

        The tensors are allocated once and updated in place.
        """
        if self._attempts == 1:
            self._try(mask)
            return self.launch
        self._pending.copy_(mask)
        for _ in range(self._attempts):
            self._attempt()
            if may_look(self._pending) and not bool(self._pending.any()):
                break
        self._repeat(mask)
        self._forecast(self._pending)  # of the ball that the world has now
        self._reject()
        return self.launch

    @property
    def accepted(self) -> Tensor:
        """(N,) bool, the worlds whose last sample landed well; with one attempt nobody looks."""
        return ~self._pending

    def _find_good(self, config: ServeConfig) -> None:
        """A first good serve for every world."""
        everyone = torch.ones_like(self._pending)
        self._pending.copy_(everyone)
        for _ in range(FIRST_ATTEMPTS):
            self._attempt()
            if rehearsing() or not bool(self._pending.any()):
                return self._repeat(everyone)
        limits = ", ".join(f"serve.{name}={limit}" for name, limit in config.limits().items())
        left = int(self._pending.sum())
        raise ConfigError(
            f"serve={config.name}: {left} of {len(everyone)} worlds found no serve that lands on the robot's half "
            f"and keeps {limits or 'off the net'} in {FIRST_ATTEMPTS} attempts: widen these, or narrow the ranges of "
            "position and velocity"
        )

    def _attempt(self) -> None:
        """Sample the pending worlds' serves, and leave those pending whose serve does not land well."""
        self._try(self._pending)
        self._forecast(self._pending)
        self._reject()

    def _try(self, mask: Tensor) -> None:
        self._sample(mask)
        self._spin(mask)


class HeadStart:
    """Moves served balls forward on their flight, by a time sampled from ``config.head_start``."""

    def __init__(self, config: ServeConfig, ball: BallSim, generator: torch.Generator) -> None:
        duration = torch.zeros(ball.num_worlds, device=ball.device)
        self._sample = UniformSampler([Column(duration, *config.head_start)], generator)
        self._skip = ball.skipper(duration)

    def give(self, mask: Tensor) -> None:
        """Sample a time for each world of ``mask`` (N,) bool and move its ball forward by it."""
        self._sample(mask)
        self._skip(mask)


class PoseSampler:
    """Samples the state in which a robot starts an episode."""

    def __init__(
        self,
        config: ResetConfig,
        robot: RobotConfig,
        num_worlds: int,
        nominal: Tensor,
        limits: tuple[Tensor, Tensor],
        generator: torch.Generator,
    ) -> None:
        device, joints = nominal.device, nominal.shape[0]
        self._qpos = torch.zeros(num_worlds, 7 + joints, device=device)
        self._qvel = torch.zeros(num_worlds, 6 + joints, device=device)
        self._qpos[:, 2] = robot.base_height
        yaw = torch.zeros(num_worlds, device=device)
        columns = columns_of(self._qpos[:, :2], [config.base_x, config.base_y])
        columns.append(Column(yaw, *config.yaw))
        rates = [config.roll_pitch_rate, config.roll_pitch_rate, config.yaw_rate]
        columns += columns_of(self._qvel[:, :6], [*[config.linear_velocity] * 3, *rates])
        ends = zip(*(limit.tolist() for limit in limits), strict=True)
        ranges = _joint_ranges(config, robot, nominal.tolist())
        columns += columns_of(self._qpos[:, 7:], [(*pair, *end) for pair, end in zip(ranges, ends, strict=True)])
        self._sample = UniformSampler(columns, generator)
        self._turn = Launch(turn, num_worlds, device, yaw=yaw, qpos=self._qpos)

    def sample(self, mask: Tensor) -> tuple[Tensor, Tensor]:
        """qpos (N, 7 + J) and qvel (N, 6 + J) of MuJoCo; joints within their limits and at rest.

        New in the worlds of ``mask`` (N,) bool; the tensors are allocated once and updated in place.
        """
        self._sample(mask)
        self._turn()
        return self._qpos, self._qvel


def _joint_ranges(config: ResetConfig, robot: RobotConfig, nominal: list[float]) -> list[tuple[float, float]]:
    """Lowest and highest angle of each joint at the start of an episode, rad."""
    spec, ranges = RobotSpec.of(robot), []
    for name, angle in zip(spec.joints, nominal, strict=True):
        if name in spec.arm:
            ends = (angle + end for end in config.right_arm_offset)
        else:
            ends = (angle * end for end in config.joint_scale)
        least, most = robot.reset_limits.get(name, (-math.inf, math.inf))
        low, high = (min(max(end, least), most) for end in ends)
        ranges.append((low, high))
    return ranges
