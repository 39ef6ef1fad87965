"""Joint targets on their way to the motors: each world's delay, and the play of its gears."""

from __future__ import annotations

import math

import torch
import warp as wp
from torch import Tensor

from pace.arrays.launch import Launch, MaskedLaunch


@wp.kernel
def _spread_delay(delay: wp.array[float], physics_dt: float, control_dt: float, share: wp.array3d[float]):
    """Share of each physics step in which targets of each age, in control steps, or younger ones have arrived."""
    world = wp.tid()
    for step in range(share.shape[1]):
        for age in range(share.shape[2]):
            since = float(step + 1) * physics_dt + float(age) * control_dt - delay[world]
            share[world, step, age] = wp.clamp(since / physics_dt, 0.0, 1.0)


@wp.kernel
def _hold(mask: wp.array[wp.bool], qpos: wp.array3d[float], held: wp.array3d[float]):
    """The joints of a masked world are told to stay where they are."""
    world, joint = wp.tid()
    if not mask[world]:
        return
    for age in range(held.shape[1]):
        held[world, age, joint] = qpos[world, 0, 7 + joint]


class Actuation:
    """Targets (N, J) of a control step, to those of its S physics steps.

    A physics step in which a new target arrives gets the mean of both. Play of a gear is a dead zone of the motor: it
    turns by up to half of the play before it drives the joint. That is found once a control step, from the joint's
    position at its beginning, and the sensors read the joint itself.

    Args: delay (N,) s and backlash (N,) rad, sampled by the owner; ``backlash`` may be ``None``: no gear has any;
    longest_delay: s; nominal (J,) rad; qpos_path (N, S + 1, 7 + J) of the engine; physics_dt, control_dt: s.
    Attributes: ``held`` (N, D, J) rad: targets of the last D control steps, the newest first.
    """

    def __init__(
        self,
        delay: Tensor,
        backlash: Tensor | None,
        longest_delay: float,
        nominal: Tensor,
        qpos_path: Tensor,
        physics_dt: float,
        control_dt: float,
    ) -> None:
        n, substeps, device = len(delay), qpos_path.shape[1] - 1, delay.device
        ages = max(1, math.ceil(longest_delay / control_dt - 1e-6))
        self.held = nominal.repeat(n, ages, 1)
        self._half_play = None if backlash is None else backlash.mul(0.5).unsqueeze(-1)
        self._backlash = backlash
        self._joint_position = qpos_path[:, -1, 7:]
        self._share = torch.zeros(n, substeps, ages, device=device)
        self._targets = torch.zeros(n, substeps, len(nominal), device=device)
        times = {"delay": delay, "physics_dt": physics_dt, "control_dt": control_dt}
        self._spread = Launch(_spread_delay, n, device, share=self._share, **times)
        #: Tells the joints of the worlds of a mask (N,) bool to stay where ``qpos_path`` begins.
        self.hold = MaskedLaunch(_hold, (n, len(nominal)), device, qpos=qpos_path, held=self.held)
        self.sample()

    def sample(self) -> None:
        """Take over new delays and plays."""
        self._spread()
        if self._half_play is not None and self._backlash is not None:
            torch.mul(self._backlash.unsqueeze(-1), 0.5, out=self._half_play)

    def __call__(self, targets: Tensor) -> Tensor:
        """Targets (N, J) rad, given at a control step's beginning -> (N, S, J) of its physics steps, overwritten by the
        next call."""
        ages = self.held.shape[1]
        newer = targets if self._half_play is None else self._without_play(targets)
        first, out = newer, self._targets
        for age in range(ages):
            older = self.held[:, age]
            change = (newer - older).unsqueeze(1)
            share = self._share[:, :, age : age + 1]
            if age == 0:
                torch.mul(share, change, out=out)
            else:
                out.addcmul_(share, change)
            newer = older
        out += newer.unsqueeze(1)
        for age in range(ages - 1, 0, -1):
            self.held[:, age].copy_(self.held[:, age - 1])
        self.held[:, 0].copy_(first)
        return out

    def _without_play(self, targets: Tensor) -> Tensor:
        """The targets less the way that the motor turns in the play."""
        assert self._half_play is not None
        way = targets - self._joint_position
        return targets - way.clamp(-self._half_play, self._half_play)
