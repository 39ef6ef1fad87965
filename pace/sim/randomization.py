"""Per-world random parameters of robot, motor, ball, air and contact, and random pushes.

The worlds of a mask are resampled on the device (:mod:`pace.arrays.draws`), so that a reset never waits for the host.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import mujoco
import torch
import warp as wp
from torch import Tensor

from pace.arrays.draws import Column, ColumnArrays, UniformSampler, columns_of
from pace.arrays.launch import Launch, MaskedLaunch, table
from pace.arrays.state import Stateful, tensors_named, with_prefix
from pace.arrays.tensors import allocate
from pace.config.ball import BallConfig
from pace.config.base import ConfigError
from pace.config.sim import RandomizationConfig
from pace.sim.ball.ball import BallParams
from pace.sim.engine.base import EngineParams
from pace.sim.kinematics import Mount, MountArrays

#: Engine parameters that are sampled directly from the range of the same name.
SAMPLED_ENGINE_PARAMS = (
    "friction",
    "trunk_mass",
    "trunk_com",
    "kp_scale",
    "kd_scale",
    "armature_scale",
    "effort_scale",
)
#: Likewise, sampled after all others, so that these of a seed are the same as before they existed.
LATER_ENGINE_PARAMS = ("speed_scale", "ankle_effort_scale", "joint_friction", "joint_damping")
#: Ball parameter -> (range, whether the sample scales the nominal value or is added to it).
SAMPLED_BALL_PARAMS = {
    "mass": ("ball_mass_scale", True),
    "drag_coefficient": ("drag_scale", True),
    "magnus_coefficient": ("magnus", False),
    "table_restitution": ("table_restitution", False),
    "table_friction": ("table_friction", False),
    "paddle_restitution": ("paddle_restitution", False),
    "paddle_friction": ("paddle_friction", False),
    "table_drag": ("drag_scale", True),
    "table_lift": ("lift_scale", True),
    "table_tangential_restitution": ("table_tangential_restitution", False),
    "paddle_tangential_restitution": ("paddle_tangential_restitution", False),
    "paddle_drilling_loss": ("paddle_drilling_loss", False),
}
#: Restitution above one would create energy; friction below zero would too.
BALL_LIMITS = {
    "table_restitution": (0.0, 1.0),
    "paddle_restitution": (0.0, 1.0),
    "table_tangential_restitution": (-1.0, 1.0),
    "paddle_tangential_restitution": (-1.0, 1.0),
    "paddle_drilling_loss": (0.0, 1.0),
}


#: Control steps, the longest delay of a target.
LONGEST_DELAY = 4
#: How the paddle differs from the model's: tilt (rad) and its direction (rad); shift (m), its direction (rad) and the
#: part of it along the face's normal.
MOUNT_COLUMNS = ("tilt", "tilt_direction", "shift", "shift_direction", "shift_height")


@wp.kernel
def _mount_paddle(mask: wp.array[wp.bool], error: wp.array2d[wp.float32], mount: MountArrays):
    """Put a masked world's paddle where its error says; the link's x axis is the normal of a paddle without one."""
    world = wp.tid()
    if not mask[world]:
        return
    tilt, direction = error[world, 0], error[world, 1]
    across = wp.sin(tilt)
    mount.normal[world] = wp.vec3(wp.cos(tilt), across * wp.cos(direction), across * wp.sin(direction))
    height, around = error[world, 4], error[world, 3]
    radius = wp.sqrt(wp.max(1.0 - height * height, 0.0))
    mount.offset[world] = error[world, 2] * wp.vec3(height, radius * wp.cos(around), radius * wp.sin(around))


@wp.kernel
def _keep_preset(mask: wp.array[wp.bool], choice: wp.array[wp.float32], share: float, nominal: wp.array[ColumnArrays]):
    """Put the preset's numbers, the low ends of ``nominal``, into a share of the masked worlds."""
    world = wp.tid()
    if not mask[world] or choice[world] >= share:
        return
    for i in range(nominal.shape[0]):
        nominal[i].values[world] = nominal[i].low


@wp.kernel
def _push(
    seed: wp.array[wp.int32],
    control_dt: float,
    interval: wp.vec2,
    velocity: wp.vec2,
    until_push: wp.array[wp.float32],
    push: wp.array2d[wp.float32],
):
    """One world's time to its next push, s, and the current push (x, y), m/s; zero if none is due."""
    world = wp.tid()
    left = until_push[world] - control_dt
    x, y = 0.0, 0.0
    if left < 0.0:
        random = wp.rand_init(seed[0], world)
        left = interval[0] + wp.randf(random) * (interval[1] - interval[0])
        x = velocity[0] + wp.randf(random) * (velocity[1] - velocity[0])
        y = velocity[0] + wp.randf(random) * (velocity[1] - velocity[0])
    until_push[world] = left
    push[world, 0] = x
    push[world, 1] = y


def _require_possible(name: str, sampled: tuple[float, float], limits: tuple[float, float]) -> None:
    """Errors: :class:`ConfigError` for samples that are all beyond the limits, to which they would be clamped."""
    if sampled[1] < limits[0] - 1e-6 or sampled[0] > limits[1] + 1e-6:
        got = f"[{sampled[0]:g}, {sampled[1]:g}]"
        raise ConfigError(f"randomization.{name} with this ball gives {got}: nothing within {list(limits)}")


def require_bodies(model: mujoco.MjModel, config: RandomizationConfig) -> None:
    """Errors: :class:`ConfigError` for a trunk without mass."""
    trunk, least = float(model.body_mass[int(model.jnt_bodyid[0])]), config.trunk_mass[0]
    if trunk + least <= 0.0:
        raise ConfigError(f"randomization.trunk_mass: with {least:g} kg nothing is left of the trunk's {trunk:.1f} kg")


class Randomizer(Stateful):
    """Samples the parameters of N worlds at reset, and the pushes in between.

    Attributes: ``actuator_delay`` (N,) s; ``backlash`` (N,) rad; ``paddle_error`` (N, 5), columns of ``MOUNT_COLUMNS``,
    put into effect in the ``mount`` that is given; ``push`` (N, nv) velocity to add to the generalized velocity before
    the next control step (m/s on the base's x and y, zero elsewhere).
    """

    def __init__(
        self,
        config: RandomizationConfig,
        ball: BallConfig,
        engine_params: EngineParams,
        ball_params: BallParams,
        generator: torch.Generator,
        num_velocities: int,
        control_dt: float,
        mount: Mount | None = None,
    ) -> None:
        self.config = config
        self._engine_params = engine_params
        self._ball_params = ball_params
        self._nominal_ball = {name: float(getattr(ball, name)) for name in SAMPLED_BALL_PARAMS}
        self._generator = generator
        longest = LONGEST_DELAY * control_dt
        if config.actuator_delay[1] > longest:
            raise ConfigError(
                f"randomization.actuator_delay must lie within 0 and {longest:g} s ({LONGEST_DELAY} steps)"
            )
        num_worlds, device = engine_params.friction.shape[0], engine_params.friction.device
        self.actuator_delay, self.backlash = (torch.zeros(num_worlds, device=device) for _ in range(2))
        self.paddle_error = torch.zeros(num_worlds, len(MOUNT_COLUMNS), device=device)
        mounted = mount or allocate(Mount, num_worlds, device)
        self._mount = MaskedLaunch(_mount_paddle, num_worlds, device, error=self.paddle_error, mount=mounted)
        self.push = torch.zeros(num_worlds, num_velocities, device=device)
        self.pushes_enabled = config.push_interval[1] > 0.0
        self._until_push = torch.zeros(num_worlds, device=device)
        self._choice = torch.zeros(num_worlds, device=device)
        self._sample = UniformSampler([*self._columns(), Column(self._choice, 0.0, 1.0)], generator)
        presets = [
            Column(getattr(ball_params, name), low=value, high=value) for name, value in self._nominal_ball.items()
        ]
        nominal = table(ColumnArrays, presets, device)
        kept = {"choice": self._choice, "share": config.preset_share, "nominal": nominal}
        self._keep_preset = MaskedLaunch(_keep_preset, num_worlds, device, **kept)
        self._seed = torch.zeros(1, dtype=torch.int32, device=device)
        sampled = {"interval": config.push_interval, "velocity": config.push_velocity, "seed": self._seed}
        kept = {"until_push": self._until_push, "push": self.push}
        self._advance_push = Launch(_push, num_worlds, device, control_dt=control_dt, **sampled, **kept)
        self.sample(torch.ones(num_worlds, dtype=torch.bool, device=device))

    def _columns(self) -> list[Column]:
        """The numbers that :meth:`sample` samples: storage, range and limits."""
        robot = {name: getattr(self._engine_params, name) for name in SAMPLED_ENGINE_PARAMS}
        robot |= {"actuator_delay": self.actuator_delay, "push_interval": self._until_push}
        columns = []
        for name, target in robot.items():
            low, high = getattr(self.config, name)
            columns += [Column(values, low, high) for values in target.view(target.shape[0], -1).unbind(1)]
        for name, (range_name, scales) in SAMPLED_BALL_PARAMS.items():
            nominal, ends = self._nominal_ball[name], getattr(self.config, range_name)
            low, high = (end * nominal if scales else end + nominal for end in ends)
            limits = BALL_LIMITS.get(name, (0.0, float("inf")))
            _require_possible(range_name, (low, high), limits)
            columns.append(Column(getattr(self._ball_params, name), low, high, *limits))
        for name in LATER_ENGINE_PARAMS:
            columns.append(Column(getattr(self._engine_params, name), *getattr(self.config, name)))
        columns.append(Column(self.backlash, *self.config.backlash))
        return columns + columns_of(self.paddle_error, self._mount_ranges())

    def _mount_ranges(self) -> list[list[float]]:
        """Ranges of ``MOUNT_COLUMNS``: of an angle all around, of a height along the axis of a unit sphere."""
        around = [0.0, 2.0 * math.pi]
        return [self.config.paddle_tilt, around, self.config.paddle_shift, around, [-1.0, 1.0]]

    def sample(self, mask: Tensor) -> None:
        """Resample the parameters of the worlds of ``mask`` (N,) bool."""
        self._sample(mask)
        if self.config.preset_share > 0.0:
            self._keep_preset(mask)
        self._mount(mask)

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Load the result of :meth:`state_dict`."""
        super().load_state_dict(state)
        self._mount(torch.ones_like(self.backlash, dtype=torch.bool))

    def update_push(self) -> Tensor:
        """Step the push timers by one control step; return ``push`` (N, nv), zero if no push is due."""
        self._seed.random_(generator=self._generator)
        self._advance_push()
        return self.push

    def state_tensors(self) -> dict[str, Tensor]:
        """All samples, for an exact resume."""
        engine = with_prefix("engine", tensors_named(self._engine_params, SAMPLED_ENGINE_PARAMS + LATER_ENGINE_PARAMS))
        ball = with_prefix("ball", tensors_named(self._ball_params, tuple(SAMPLED_BALL_PARAMS)))
        motors = {"actuator_delay": self.actuator_delay, "backlash": self.backlash}
        return engine | ball | motors | {"until_push": self._until_push, "paddle_error": self.paddle_error}
