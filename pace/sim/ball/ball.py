"""The ball of N worlds: its parameters, its flight through one control step with events, and the forecast of a flight.

Frame: origin on the floor below the table's centre, x towards the opponent, z up; the own half is x < 0. SI units.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import torch
import warp as wp
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from pace.arrays.launch import Bound, Launch, MaskedLaunch
from pace.arrays.tensors import allocate
from pace.config.ball import AirConfig, BallConfig, TableConfig
from pace.config.base import ConfigError, config_dir, parse
from pace.sim.ball.aero import AirTables
from pace.sim.ball.air_tables import air_tables, air_tensors
from pace.sim.ball.forecast_kernel import FORECAST_HORIZON, forecast_flight
from pace.sim.ball.rebound import Material
from pace.sim.ball.robot_body import RobotBody
from pace.sim.ball.scene import Scene
from pace.sim.ball.skip_kernel import skip_flight
from pace.sim.ball.state import BallEvents, BallState, Forecast
from pace.sim.ball.step_kernel import fly_step

__all__ = ["FORECAST_HORIZON", "BallEvents", "BallParams", "BallSim", "Forecast", "ball_preset"]

#: Preset that is used if none is named.
DEFAULT_PRESET = "rubber"

#: m; the ball's radius rounds the net's edge, so the thickness of the cloth hardly matters.
NET_THICKNESS = 0.002
#: Numbers of one knot of a paddle path: centre, normal, linear and angular velocity.
PATH_WIDTH = 12

Value = float | Tensor


@lru_cache
def ball_preset(name: str) -> BallConfig:
    """``configs/ball/<name>.yaml``, checked. Errors: :class:`pace.config.ConfigError` for an unknown name."""
    folder = config_dir() / "ball"
    path = folder / f"{name}.yaml"
    if not path.is_file() or name.startswith("_"):
        names = sorted(p.stem for p in folder.glob("*.yaml") if not p.stem.startswith("_"))
        raise ConfigError(f"no ball preset {name!r}; there are {', '.join(names)}")
    return parse(_with_layers(path), BallConfig)


def _measured_air() -> AirConfig:
    """The tables of the default preset."""
    air = ball_preset(DEFAULT_PRESET).air
    assert air is not None  # configs/ball/_air.yaml
    return air


def _with_layers(path: Path) -> DictConfig:
    """A file of configs/ball/ over the files that its ``defaults`` name."""
    preset = OmegaConf.load(path)
    assert isinstance(preset, DictConfig)
    layers = [_with_layers(path.parent / f"{layer}.yaml") for layer in preset.pop("defaults", [])]
    merged = OmegaConf.merge(*layers, preset)
    assert isinstance(merged, DictConfig)
    return merged


@dataclass(frozen=True)
class BallParams:
    """Ball, air and contacts: each a float, or a tensor (N,) with one value a world.

    The ball is a hollow sphere. Restitution is ``restitution - slope * |v_n|``, never below ``min_restitution``;
    tangential restitution ``tangential_restitution - slope * |u|``, u the slip of the contact point (0: it stops;
    positive: it is reversed). C_d is ``drag_coefficient`` plus ``table_drag`` times the measured table of ``ball.air``,
    and lift likewise (:mod:`pace.sim.ball.aero`).
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
    table_drag: Value = 0.0  # share of the measured C_d
    table_lift: Value = 0.0  # share of the measured C_M
    table_tangential_restitution: Value = 0.0
    paddle_tangential_restitution: Value = 0.0
    paddle_tangential_restitution_slope: Value = 0.0  # s / m
    paddle_drilling_loss: Value = 0.0  # share of the spin about the paddle's normal that a hit takes

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


#: Order of the columns of the kernels' parameter tensor, which :func:`pace.sim.ball.scene.read_body` reads.
PARAM_NAMES = tuple(f.name for f in fields(BallParams))


def _material(restitution: float, friction: float) -> Material:
    material = Material()
    material.restitution = restitution
    material.friction = friction
    return material


def _scene(table: TableConfig, path_dt: float, air: AirTables) -> Scene:
    """Table, net, floor, materials and air in the kernels' form, without the paths of paddle and body."""
    scene = Scene()
    scene.air = air
    scene.table_centre = wp.vec3(0.0, 0.0, table.height - 0.5 * table.thickness)
    scene.table_half = wp.vec3(0.5 * table.length, 0.5 * table.width, 0.5 * table.thickness)
    scene.net_centre = wp.vec3(0.0, 0.0, table.height + 0.5 * table.net_height)
    scene.net_half = wp.vec3(0.5 * NET_THICKNESS, 0.5 * table.width + table.net_overhang, 0.5 * table.net_height)
    scene.net = _material(table.net_restitution, table.net_friction)
    scene.floor = _material(table.floor_restitution, table.floor_friction)
    scene.skin = _material(table.body_restitution, table.body_friction)
    scene.paddle_radius = table.paddle_radius
    scene.paddle_half_thickness = table.paddle_half_thickness
    scene.path_dt = path_dt
    return scene


def _nobody(num_worlds: int, device: torch.device) -> RobotBody:
    """A body without shapes."""
    body = RobotBody()
    body.near_count = wp.zeros(num_worlds, dtype=wp.int32, device=wp.device_from_torch(device))
    return body


class BallSim(BallState):
    """The ball of N worlds. ``fly`` moves it through one control step, ``forecast`` looks ahead.

    All tensors are float32 on ``device`` and share memory with Warp. They are allocated once and updated in place; edit
    them in place too.

    Attributes:
        position, velocity, spin: (N, 3) m, m/s, rad/s: the ball.
        in_view: (N,) bool, the sensors can see the ball.
        params: :class:`BallParams` of tensors (N,).
        events: :class:`BallEvents` of the last control step.
        nearest_paddle_distance: (N,) m, smallest distance of ball's and paddle's centre in the last control step.
        forecast_result: :class:`Forecast`, the last one made for each world.

    Args:
        num_worlds: N.
        device: torch device of all tensors.
        params: ball, air and contacts, one for all worlds or one a world.
        table: table, net, floor and the paddle's size.
        control_dt: s, duration of one ``fly``.
        substeps: S, intervals between the knots of a paddle path.
        ball_dt: s, longest sub-step of a flight.
        air: measured coefficients, of which ``params.table_drag`` and ``params.table_lift`` are shares; ``None``:
            those of the default preset.
        robot: the robot's body, posed before each flight by its owner (:mod:`pace.sim.bodies`); ``None``: there is only
            the paddle.
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
        air: AirConfig | None = None,
        robot: RobotBody | None = None,
    ) -> None:
        if num_worlds < 1:
            raise ValueError(f"num_worlds must be at least 1, got {num_worlds}")
        self.num_worlds = num_worlds
        self.device = torch.device(device)
        self.control_dt = control_dt
        super().__init__(**vars(allocate(BallState, num_worlds, device)))
        self.in_view = torch.ones(num_worlds, dtype=torch.bool, device=device)
        self.nearest_paddle_distance = torch.zeros(num_worlds, device=device)
        matrix = params.matrix(num_worlds, device)
        self.params = BallParams(*matrix.unbind(1))
        self.events = allocate(BallEvents, num_worlds, device)
        self.forecast_result = allocate(Forecast, num_worlds, device)
        self._path_shape = (num_worlds, substeps + 1, PATH_WIDTH)
        self._air = air_tensors(air or _measured_air(), device)
        self._scene = _scene(table, control_dt / substeps, air_tables(self._air))
        self._robot = self._scene.robot = robot or _nobody(num_worlds, self.device)
        self._flown = {"params": matrix, "scene": self._scene, "ball_dt": ball_dt}  # arguments of every flight
        self._ask = allocate(BallState, num_worlds, device)
        self._ahead: dict[float, MaskedLaunch] = {}  # by intercept_x, from _ask
        self._fly = Bound(self._record_flight, paddle_path=None)

    def _record_flight(self, path: Tensor) -> Launch:
        if path.shape != self._path_shape or path.dtype != torch.float32 or not path.is_contiguous():
            raise ValueError(
                f"paddle_path must be contiguous float32 of shape {self._path_shape}, "
                f"not {path.dtype} of shape {tuple(path.shape)}"
            )
        self._scene.path = wp.from_torch(path)
        given = {"nearest": self.nearest_paddle_distance, "control_dt": self.control_dt} | self._flown
        return Launch(fly_step, self.num_worlds, self.device, ball=self, events=self.events, **given)

    def fly(self, paddle_path: Tensor) -> None:
        """Fly one control step along ``paddle_path`` (N, S + 1, 12), world frame, S + 1 equidistant instants:
        centre (m), unit normal of a face, velocity of the centre (m/s), angular velocity (rad/s).

        Between the instants centre and normal follow cubics through their values (the velocities are used only if
        S = 1), and the angular velocity is interpolated linearly.
        Give the same tensor each time: another one is bound again, which takes longer. The impulses of ball on body
        do not act back on the robot; those on the paddle are in ``events``.

        Errors: ``ValueError`` for another shape, type or memory layout.
        """
        self._fly(paddle_path)()

    def forecast(self, mask: Tensor, position: Tensor, velocity: Tensor, spin: Tensor, intercept_x: float) -> None:
        """Simulate ahead from position, velocity and spin (N, 3) in the worlds of ``mask`` (N,) bool.

        Fills their rows of ``forecast_result`` and leaves the others; ``intercept_x`` is in m. The flight collides with
        net, table and floor, but not with a robot.
        """
        for own, given in zip(vars(self._ask).values(), (position, velocity, spin), strict=True):
            own.copy_(given)
        if intercept_x not in self._ahead:
            self._ahead[intercept_x] = self.forecaster(self._ask, intercept_x)
        self._ahead[intercept_x](mask)

    def forecaster(self, ball: BallState, intercept_x: float) -> MaskedLaunch:
        """:meth:`forecast` of a mask, always from these tensors: it reads them in place, which saves copies."""
        given = {"forecast": self.forecast_result, "intercept_x": intercept_x} | self._flown
        return MaskedLaunch(forecast_flight, self.num_worlds, self.device, ball=ball, **given)

    def skipper(self, duration: Tensor) -> MaskedLaunch:
        """A function of a mask (N,) bool that moves those balls forward by ``duration`` (N,) s of their flight at once.

        The flight ends just before the first contact; no event is recorded.
        """
        return MaskedLaunch(skip_flight, self.num_worlds, self.device, ball=self, duration=duration, **self._flown)
