"""The ball of N worlds: its parameters, its flight through one control step with events, and the forecast of a flight.

Frame: origin on the floor below the table's centre, x towards the opponent, z up; the own half is x < 0. SI units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import torch
import warp as wp
from omegaconf import OmegaConf
from torch import Tensor

from pace.arrays.share import record, share, share_all
from pace.config.base import ConfigError, config_dir, parse
from pace.config.sim import BallConfig, TableConfig
from pace.sim.ball.flight import Scene
from pace.sim.ball.kernels import (
    FORECAST_HORIZON,
    EventArrays,
    ForecastArrays,
    fly_step,
    forecast_flight,
    skip_flight,
)
from pace.sim.ball.rebound import Material

__all__ = ["FORECAST_HORIZON", "BallEvents", "BallParams", "BallSim", "Forecast", "ball_preset"]

#: Preset that is used where none is named.
DEFAULT_PRESET = "rubber"

#: m; the ball's radius rounds the net's edge, so the cloth's own thickness hardly matters.
NET_THICKNESS = 0.002
#: Numbers of one knot of a paddle path: centre, normal, linear and angular velocity.
PATH_WIDTH = 12

Value = float | Tensor


@lru_cache
def ball_preset(name: str) -> BallConfig:
    """``configs/ball/<name>.yaml``, checked. Errors: :class:`pace.config.ConfigError` for a name that is not there."""
    folder = config_dir() / "ball"
    path = folder / f"{name}.yaml"
    if not path.is_file() or name.startswith("_"):
        names = sorted(p.stem for p in folder.glob("*.yaml") if not p.stem.startswith("_"))
        raise ConfigError(f"no ball preset {name!r}; there are {', '.join(names)}")
    preset = OmegaConf.to_container(OmegaConf.load(path))
    assert isinstance(preset, dict)
    layers = [OmegaConf.load(folder / f"{layer}.yaml") for layer in preset.pop("defaults", [])]
    return parse(OmegaConf.merge(*layers, preset), BallConfig)  # type: ignore[arg-type]


@dataclass(frozen=True)
class BallParams:
    """Ball, air and contacts: each a float, or a tensor (N,) with one value a world.

    Restitution is ``restitution - slope * |v_n|``, never below ``min_restitution``. The ball is a hollow sphere.
    """

    mass: Value  # kg
    radius: Value  # m
    air_density: Value  # kg / m^3
    drag_coefficient: Value
    magnus_coefficient: Value
    table_restitution: Value
    table_restitution_slope: Value  # s / m
    table_friction: Value
    paddle_restitution: Value
    paddle_restitution_slope: Value  # s / m
    paddle_friction: Value
    min_restitution: Value = 0.0

    @classmethod
    def from_config(cls, config: BallConfig) -> BallParams:
        """The numbers of a ball configuration."""
        return cls(**{name: getattr(config, name) for name in PARAM_NAMES})

    @classmethod
    def preset(cls, name: str) -> BallParams:
        """The numbers of ``configs/ball/<name>.yaml``. Errors: :class:`pace.config.ConfigError` for an unknown name."""
        return cls.from_config(ball_preset(name))

    def expand(self, num_worlds: int, device: torch.device | str) -> BallParams:
        """Tensors (N,), float32, on ``device``: columns of one (N, P) tensor, to be edited in place.

        Errors: as :meth:`matrix`.
        """
        return BallParams(*self.matrix(num_worlds, device).unbind(1))

    def matrix(self, num_worlds: int, device: torch.device | str) -> Tensor:
        """One (N, P) float32 tensor, a column for each of :data:`PARAM_NAMES`.

        Errors: ``ValueError`` that names the field, for a tensor of another shape than (N,) or ().
        """
        data = torch.empty(num_worlds, len(PARAM_NAMES), device=device)
        for column, name in enumerate(PARAM_NAMES):
            value = torch.as_tensor(getattr(self, name), dtype=torch.float32)
            if value.shape not in ((), (num_worlds,)):
                raise ValueError(f"BallParams.{name} must be a number or have shape ({num_worlds},), not {value.shape}")
            data[:, column] = value
        return data


#: Order of the columns of the kernels' parameter tensor, which :func:`pace.sim.ball.flight.read_body` reads.
PARAM_NAMES = tuple(f.name for f in fields(BallParams))


@dataclass(frozen=True)
class BallEvents:
    """What the ball met in the last control step; every flight overwrites all of it.

    Counts are of contacts that begin; rolling or resting on counts once. The rims of the table's top belong to the top
    (ITTF 2.1.5); its sides and underside count as ``edge``. Times are s into the control step, of the first contact of
    that kind, infinite if there is none. The ``hit`` values belong to the first paddle hit and are zero without one.
    """

    own_bounce: Tensor  # (N,) int32
    opponent_bounce: Tensor  # (N,) int32
    paddle_hit: Tensor  # (N,) int32
    net: Tensor  # (N,) int32
    floor: Tensor  # (N,) int32
    edge: Tensor  # (N,) int32
    own_bounce_time: Tensor  # (N,) s
    opponent_bounce_time: Tensor  # (N,) s
    paddle_hit_time: Tensor  # (N,) s
    net_time: Tensor  # (N,) s
    floor_time: Tensor  # (N,) s
    edge_time: Tensor  # (N,) s
    hit_point: Tensor  # (N, 3) m, where ball and paddle touched
    hit_position: Tensor  # (N, 3) m, ball's centre
    hit_offset: Tensor  # (N, 3) m, ball's centre minus paddle's centre
    hit_normal: Tensor  # (N, 3) unit vector from the paddle to the ball
    hit_relative_velocity: Tensor  # (N, 3) m/s, ball's centre minus the paddle's point, before the impact
    hit_velocity_in: Tensor  # (N, 3) m/s
    hit_velocity_out: Tensor  # (N, 3) m/s
    hit_spin_out: Tensor  # (N, 3) rad/s
    hit_rim: Tensor  # (N,) bool, the rim or its edge rather than a face
    paddle_impulse: Tensor  # (N, 3) N s on the paddle, sum over the step
    impulse_point: Tensor  # (N, 3) m, where the last of it acted
    bounce_position: Tensor  # (N, 3) m, ball's centre at the step's first bounce on the table's top

    @classmethod
    def allocate(cls, num_worlds: int, device: torch.device | str) -> BallEvents:
        """No event in any world."""
        return cls(**{f.name: _event_tensor(f.name, num_worlds, device) for f in fields(cls)})


def _event_tensor(name: str, num_worlds: int, device: torch.device | str) -> Tensor:
    if name.endswith("_time"):
        return torch.full((num_worlds,), float("inf"), device=device)
    if name == "hit_rim":
        return torch.zeros(num_worlds, device=device, dtype=torch.bool)
    if name.startswith(("hit_", "paddle_impulse", "impulse_", "bounce_")):
        return torch.zeros(num_worlds, 3, device=device)
    return torch.zeros(num_worlds, device=device, dtype=torch.int32)


@dataclass(frozen=True)
class Forecast:
    """A flight ahead without a paddle: tensors (N, ...), float32, s and m from now on, NaN where there is none.

    ``bounce`` is the first on the own half, ``apex`` where the ball first stops rising after it, and ``intercept`` the
    later of the apex and the passing of x = intercept_x. ``landing`` is the first contact with the table's top or the
    floor. Positions are of the ball's centre. The forecast ends on the floor, or after :data:`FORECAST_HORIZON`.
    """

    bounce: Tensor  # (N, 3) m
    bounce_time: Tensor  # (N,) s
    bounce_velocity: Tensor  # (N, 3) m/s, after the bounce
    apex: Tensor  # (N, 3) m
    apex_time: Tensor  # (N,) s
    intercept: Tensor  # (N, 3) m
    intercept_time: Tensor  # (N,) s
    intercept_velocity: Tensor  # (N, 3) m/s
    landing: Tensor  # (N, 3) m
    landing_time: Tensor  # (N,) s
    landing_own: Tensor  # (N,) bool, the landing is on the own half of the table
    landing_opponent: Tensor  # (N,) bool, the landing is on the opponent's half
    net_height: Tensor  # (N,) m, z where the ball first passes x = 0 towards the opponent

    @classmethod
    def allocate(cls, num_worlds: int, device: torch.device | str) -> Forecast:
        """A forecast of nothing: NaN, and no landing."""
        vectors = ("bounce", "bounce_velocity", "apex", "intercept", "intercept_velocity", "landing")
        tensors = {}
        for f in fields(cls):
            shape = (num_worlds, 3) if f.name in vectors else (num_worlds,)
            flag = f.name in ("landing_own", "landing_opponent")
            tensors[f.name] = torch.full(
                shape, 0 if flag else float("nan"), device=device, dtype=torch.bool if flag else torch.float32
            )
        return cls(**tensors)


def _material(restitution: float, friction: float) -> Material:
    material = Material()
    material.restitution = restitution
    material.friction = friction
    return material


def _scene(table: TableConfig, path: Tensor, path_dt: float) -> Scene:
    """Table, net, floor and the paddle's path as the kernels read them."""
    scene = Scene()
    scene.table_centre = wp.vec3(0.0, 0.0, table.height - 0.5 * table.thickness)
    scene.table_half = wp.vec3(0.5 * table.length, 0.5 * table.width, 0.5 * table.thickness)
    scene.net_centre = wp.vec3(0.0, 0.0, table.height + 0.5 * table.net_height)
    scene.net_half = wp.vec3(0.5 * NET_THICKNESS, 0.5 * table.width + table.net_overhang, 0.5 * table.net_height)
    scene.net = _material(table.net_restitution, table.net_friction)
    scene.floor = _material(table.floor_restitution, table.floor_friction)
    scene.paddle_radius = table.paddle_radius
    scene.paddle_half_thickness = table.paddle_half_thickness
    scene.path = wp.from_torch(path)
    scene.path_dt = path_dt
    return scene


class BallSim:
    """The ball of N worlds. ``fly`` moves it through one control step, ``forecast`` looks ahead.

    All tensors are float32 on ``device``, share memory with Warp and are the same objects for ever: edit them in place.

    Attributes:
        position, velocity, spin: (N, 3) m, m/s, rad/s: the ball.
        params: :class:`BallParams` of tensors (N,).
        events: :class:`BallEvents` of the last control step.
        nearest_paddle_distance: (N,) m, smallest distance of ball's and paddle's centre in the last control step.
        forecast_result: :class:`Forecast`, the last one made for each world.

    Args:
        num_worlds: N.
        device: torch device of all tensors.
        params: ball, air and contacts, one for all worlds or one a world.
        table: table, net, floor and the paddle's size.
        control_dt: s, what one ``fly`` covers.
        substeps: S, intervals between the knots of a paddle path.
        ball_dt: s, longest sub-step of a flight.
    """

    def __init__(
        self,
        num_worlds: int,
        device: torch.device | str,
        params: BallParams,
        table: TableConfig,
        control_dt: float,
        substeps: int,
        ball_dt: float,
    ) -> None:
        if num_worlds < 1:
            raise ValueError(f"num_worlds must be at least 1, got {num_worlds}")
        self.num_worlds = num_worlds
        self.device = torch.device(device)
        self.control_dt = control_dt
        self.position = torch.zeros(num_worlds, 3, device=device)
        self.velocity = torch.zeros(num_worlds, 3, device=device)
        self.spin = torch.zeros(num_worlds, 3, device=device)
        self.nearest_paddle_distance = torch.zeros(num_worlds, device=device)
        self._param_matrix = params.matrix(num_worlds, device)
        self.params = BallParams(*self._param_matrix.unbind(1))
        self.events = BallEvents.allocate(num_worlds, device)
        self.forecast_result = Forecast.allocate(num_worlds, device)
        self._path_shape = (num_worlds, substeps + 1, PATH_WIDTH)
        self._path = torch.zeros(self._path_shape, device=device)
        self._ask_mask = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self._ask = torch.zeros(3, num_worlds, 3, device=device)
        self._scene = _scene(table, self._path, control_dt / substeps)
        self._ball_dt = ball_dt
        self._ahead: dict[float, Callable[[Tensor], None]] = {}  # by intercept_x, from _ask
        self._fly = self._record_flight()

    def _record_flight(self) -> Callable[[], None]:
        """The flight along the present path, recorded so that a call only replays it."""
        ball = [share(self.position), share(self.velocity), share(self.spin)]
        events = [share_all(EventArrays, vars(self.events)), share(self.nearest_paddle_distance)]
        inputs = [*ball, wp.from_torch(self._param_matrix), self._scene, *events, self.control_dt, self._ball_dt]
        return record(fly_step, self.num_worlds, inputs, self.device)

    def fly(self, paddle_path: Tensor) -> None:
        """Fly one control step along ``paddle_path`` (N, S + 1, 12), world frame, S + 1 equidistant instants:
        centre (m), unit normal of a face, velocity of the centre (m/s), angular velocity (rad/s).

        Between the instants centre and normal follow cubics through their own values (the velocities are used only
        where S = 1), and the angular velocity is interpolated linearly.
        Give the same tensor each time: another one is bound anew, which takes longer.

        Errors: ``ValueError`` for another shape, type or memory layout.
        """
        if paddle_path is not self._path:
            self._bind_path(paddle_path)
        self._fly()

    def _bind_path(self, path: Tensor) -> None:
        if path.shape != self._path_shape or path.dtype != torch.float32 or not path.is_contiguous():
            raise ValueError(
                f"paddle_path must be contiguous float32 of shape {self._path_shape}, "
                f"not {path.dtype} of shape {tuple(path.shape)}"
            )
        self._path = path
        self._scene.path = wp.from_torch(path)
        self._fly = self._record_flight()

    def forecast(self, mask: Tensor, position: Tensor, velocity: Tensor, spin: Tensor, intercept_x: float) -> None:
        """Look ahead from position, velocity and spin (N, 3) in the worlds of ``mask`` (N,) bool.

        Fills their rows of ``forecast_result`` and leaves the others; ``intercept_x`` is in m. The flight passes
        through paddles; net, table and floor are met.
        """
        for own, given in zip(self._ask, (position, velocity, spin), strict=True):
            own.copy_(given)
        if intercept_x not in self._ahead:
            self._ahead[intercept_x] = self.forecaster(self._ask[0], self._ask[1], self._ask[2], intercept_x)
        self._ahead[intercept_x](mask)

    def forecaster(
        self, position: Tensor, velocity: Tensor, spin: Tensor, intercept_x: float
    ) -> Callable[[Tensor], None]:
        """:meth:`forecast` of a mask, always from these tensors: it reads them where they lie, which saves copies."""
        start = [share(position), share(velocity), share(spin)]
        result = share_all(ForecastArrays, vars(self.forecast_result))
        inputs = [*start, wp.from_torch(self._param_matrix), self._scene, result, intercept_x, self._ball_dt]
        return self._of_a_mask(forecast_flight, inputs)

    def _of_a_mask(self, kernel: wp.Kernel, inputs: list[Any]) -> Callable[[Tensor], None]:
        """A function of a mask (N,) bool that launches ``kernel`` with that mask and ``inputs``."""
        launch = record(kernel, self.num_worlds, [share(self._ask_mask), *inputs], self.device)

        def call(mask: Tensor) -> None:
            self._ask_mask.copy_(mask)
            launch()

        return call

    def skipper(self, duration: Tensor) -> Callable[[Tensor], None]:
        """A function of a mask (N,) bool that moves those balls on by ``duration`` (N,) s of their flight at once.

        No further than to where they are about to touch something; nothing is hit and nothing is noted.
        """
        state = [share(duration), share(self.position), share(self.velocity), share(self.spin)]
        inputs = [*state, wp.from_torch(self._param_matrix), self._scene, self._ball_dt]
        return self._of_a_mask(skip_flight, inputs)
