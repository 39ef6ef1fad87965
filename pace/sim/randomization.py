"""Per-world draws of robot, motor, ball, air and contact parameters, and of pushes.

Draws are made for all worlds and kept where a mask says so, so that a reset never waits for the host.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pace.config import BallConfig, ConfigError, RandomizationConfig
from pace.sim.ball import BallParams
from pace.sim.engine import EngineParams

#: Engine parameters that are drawn straight from the range of the same name.
ENGINE_DRAWS = ("friction", "trunk_mass", "trunk_com", "kp_scale", "kd_scale", "armature_scale", "effort_scale")
#: Ball parameter -> (range, whether the draw scales the nominal value or is added to it).
BALL_DRAWS = {
    "mass": ("ball_mass_scale", True),
    "drag_coefficient": ("drag_scale", True),
    "magnus_coefficient": ("magnus", False),
    "table_restitution": ("table_restitution", False),
    "table_friction": ("table_friction", False),
    "paddle_restitution": ("paddle_restitution", False),
    "paddle_friction": ("paddle_friction", False),
}
#: Restitution above one would create energy; friction below zero would too.
BALL_LIMITS = {"table_restitution": (0.0, 1.0), "paddle_restitution": (0.0, 1.0)}


def uniform(generator: torch.Generator, low: Tensor, high: Tensor, num_worlds: int) -> Tensor:
    """Samples (N, C) between rows ``low`` and ``high`` (C,)."""
    sample = torch.rand(num_worlds, low.shape[0], device=low.device, generator=generator)
    return sample.mul_(high - low).add_(low)


def bounds(ranges: list[list[float]], device: torch.device) -> tuple[Tensor, Tensor]:
    """Lower and upper row (C,) of C ranges."""
    table = torch.tensor(ranges, dtype=torch.float32, device=device)
    return table[:, 0].contiguous(), table[:, 1].contiguous()


class Randomizer:
    """Draws the parameters of N worlds at reset, and the pushes in between.

    Attributes: ``actuator_delay`` (N,) s; ``push`` (N, nv) velocity to add to the generalized velocity before the
    next control step (m/s on the base's x and y, zero elsewhere).
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
    ) -> None:
        self.config = config
        self._engine_params = engine_params
        self._ball_params = ball_params
        self._nominal_ball = {name: float(getattr(ball, name)) for name in BALL_DRAWS}
        self._generator = generator
        self._control_dt = control_dt
        if not 0.0 <= config.actuator_delay[0] <= config.actuator_delay[1] <= control_dt:
            raise ConfigError(f"randomization.actuator_delay must lie within one control step (0 to {control_dt} s)")
        num_worlds, device = engine_params.friction.shape[0], engine_params.friction.device
        self.actuator_delay = torch.zeros(num_worlds, device=device)
        self.push = torch.zeros(num_worlds, num_velocities, device=device)
        self.pushes_enabled = config.push_interval[1] > 0.0
        self._until_push = torch.zeros(num_worlds, device=device)
        self._drawn = self._targets()
        table = torch.tensor(self._columns(), device=device).unbind(1)
        self._low, self._high, *self._limits = (column.contiguous() for column in table)
        self._push_bounds = bounds([config.push_interval, *[config.push_velocity] * 2], device)
        self.draw(torch.ones(num_worlds, dtype=torch.bool, device=device))

    def _targets(self) -> list[Tensor]:
        """What :meth:`draw` draws, each (N, width)."""
        drawn = [getattr(self._engine_params, name) for name in ENGINE_DRAWS]
        drawn += [self.actuator_delay, self._until_push]
        drawn += [getattr(self._ball_params, name) for name in BALL_DRAWS]
        return [target if target.dim() == 2 else target.unsqueeze(-1) for target in drawn]

    def _columns(self) -> list[tuple[float, float, float, float]]:
        """For each column of :meth:`_targets` the ends of its range, and the limits within which draws are kept."""
        names, free = (*ENGINE_DRAWS, "actuator_delay", "push_interval"), (-float("inf"), float("inf"))
        rows = [(*getattr(self.config, name), *free) for name in names]
        for name, (range_name, scales) in BALL_DRAWS.items():
            nominal, ends = self._nominal_ball[name], getattr(self.config, range_name)
            low, high = (end * nominal if scales else end + nominal for end in ends)
            rows.append((low, high, *BALL_LIMITS.get(name, (0.0, float("inf")))))
        widths = [target.shape[1] for target in self._drawn]
        return [row for row, width in zip(rows, widths, strict=True) for _ in range(width)]

    def draw(self, mask: Tensor) -> None:
        """Draw new parameters for the worlds of ``mask`` (N,) bool."""
        sample = uniform(self._generator, self._low, self._high, mask.shape[0]).clamp_(*self._limits)
        wide = mask.unsqueeze(-1)
        for target, drawn in zip(self._drawn, sample.split([t.shape[1] for t in self._drawn], dim=1), strict=True):
            torch.where(wide, drawn, target, out=target)

    def update_push(self) -> Tensor:
        """Advance the push timers by one control step; return ``push`` (N, nv), zero where no push is due."""
        self._until_push -= self._control_dt
        due = self._until_push < 0.0
        sample = uniform(self._generator, *self._push_bounds, due.shape[0])
        torch.where(due, sample[:, 0], self._until_push, out=self._until_push)
        torch.mul(sample[:, 1:], due.unsqueeze(-1), out=self.push[:, :2])
        return self.push

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that was drawn, for an exact resume."""
        state = {f"engine.{name}": getattr(self._engine_params, name) for name in ENGINE_DRAWS}
        state |= {f"ball.{name}": getattr(self._ball_params, name) for name in BALL_DRAWS}
        return state | {"actuator_delay": self.actuator_delay, "until_push": self._until_push}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Put back what :meth:`state_dict` returned; shapes must match."""
        for name, tensor in self.state_dict().items():
            tensor.copy_(state[name])
