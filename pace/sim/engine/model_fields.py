"""Which model fields follow the parameters of each world, and the kernel that writes them, the same on both engines."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike
from torch import Tensor

from pace.arrays.launch import MaskedLaunch, table
from pace.sim.engine.base import EngineParams
from pace.sim.robot_spec import joints_of


@wp.struct
class Write:
    """One number of a world's model: ``base + gain * param``, or what rows before wrote there, times ``param``.

    If ``inverse`` is 1, ``1 / param`` takes the place of ``param``.
    """

    param: wp.array[wp.float32]
    float32: wp.array2d[wp.float32]  # the field (N, size), in the engine's precision; the other one is empty
    float64: wp.array2d[wp.float64]
    place: int
    base: float
    gain: float
    inverse: int
    scales: int  # 1: times what is there


@wp.kernel
def _write_fields(mask: wp.array[wp.bool], writes: wp.array[Write]):
    """Give the parameters of one masked world to its model."""
    world = wp.tid()
    if not mask[world]:
        return
    for i in range(writes.shape[0]):
        write = writes[i]
        param = write.param[world]
        if write.inverse == 1:
            param = 1.0 / param
        value = write.base + write.gain * param
        if write.float32.shape[0] > 0:
            if write.scales == 1:
                value = param * write.float32[world, write.place]
            write.float32[world, write.place] = value
        else:
            exact = wp.float64(value)
            if write.scales == 1:
                exact = wp.float64(param) * write.float64[world, write.place]
            write.float64[world, write.place] = exact


PRECISIONS = (torch.float32, torch.float64)


Where = tuple[int | slice | list[int], ...]  # part of one world's array


class Change(NamedTuple):
    """A part of a field, and its new value."""

    field: str
    where: Where
    param: Tensor  # (N,), or (N, size) with one column for each number
    base: ArrayLike = 0.0  # base and gain, to the shape of that part
    gain: ArrayLike = 0.0
    inverse: bool = False
    scales: bool = False  # times what the changes before made of it


class ModelFields:
    """Writes the model fields that follow ``params``.

    Args:
        model: the nominal robot.
        params: parameters of N worlds, edited in place.
        fields: name of :data:`NAMES` -> (N, ...) float32 or float64: the fields of N models.
    """

    NAMES = (
        "pair_friction",
        "body_mass",
        "body_subtreemass",
        "body_inertia",
        "body_ipos",
        "actuator_gainprm",
        "actuator_biasprm",
        "actuator_forcerange",
        "dof_armature",
        "dof_frictionloss",
        "dof_damping",
    )

    def __init__(self, model: mujoco.MjModel, params: EngineParams, fields: Mapping[str, Tensor]) -> None:
        count, device = params.friction.shape[0], params.friction.device
        self._params, self._fields = params, fields  # the kernel's table knows the tensors by address alone
        changes = [*_body(model, params), *_motors(model, params), *_joints(model, params)]
        writes = [write for change in changes for write in _writes(change, fields[change.field])]
        #: Gives the parameters of the worlds of a mask (N,) bool to their models.
        self.write = MaskedLaunch(_write_fields, count, device, writes=table(Write, writes, device))


def _body(model: mujoco.MjModel, params: EngineParams) -> Iterator[Change]:
    """Friction, and the trunk with the bodies fixed to it; its inertia grows in proportion to its mass."""
    trunk = int(model.jnt_bodyid[0])  # the free joint's
    mass, inertia = model.body_mass[trunk], model.body_inertia[trunk]
    yield Change("pair_friction", (slice(None), slice(2)), params.friction, 0.0, 1.0)  # both directions
    yield Change("body_mass", (trunk,), params.trunk_mass, mass, 1.0)
    for body in (0, trunk):
        yield Change("body_subtreemass", (body,), params.trunk_mass, model.body_subtreemass[body], 1.0)
    yield Change("body_inertia", (trunk,), params.trunk_mass, inertia, inertia / mass)
    yield Change("body_ipos", (trunk,), params.trunk_com, model.body_ipos[trunk], 1.0)


def _motors(model: mujoco.MjModel, params: EngineParams) -> Iterator[Change]:
    """The fields that set_to_dcmotor and set_to_position of :mod:`pace.sim.robot` write."""
    every, gains = slice(None), model.actuator_gainprm
    ankles, weaker = joints_of(model, "ankles"), params.ankle_effort_scale
    if bool((model.actuator_gaintype == mujoco.mjtGain.mjGAIN_DCMOTOR).all()):
        resistance, kp, kd, voltage = gains[:, 0], gains[:, 4], gains[:, 6], gains[:, 7]
        yield Change("actuator_gainprm", (every, 0), params.effort_scale, 0.0, resistance, inverse=True)
        yield Change("actuator_gainprm", (ankles, 0), weaker, inverse=True, scales=True)
        # the motor's constant is 1: the largest voltage is the no-load speed, and over the resistance the stall torque
        yield Change("actuator_gainprm", (every, 0), params.speed_scale, scales=True)
        yield Change("actuator_gainprm", (every, 7), params.speed_scale, 0.0, voltage)
        yield Change("actuator_gainprm", (every, 4), params.kp_scale, 0.0, kp)
        yield Change("actuator_gainprm", (every, 6), params.kd_scale, 0.0, kd)
    else:
        kp, kd = gains[:, 0], -model.actuator_biasprm[:, 2]
        yield Change("actuator_gainprm", (every, 0), params.kp_scale, 0.0, kp)
        yield Change("actuator_biasprm", (every, 1), params.kp_scale, 0.0, -kp)
        yield Change("actuator_biasprm", (every, 2), params.kd_scale, 0.0, -kd)
    yield Change("actuator_forcerange", (every,), params.effort_scale, 0.0, model.actuator_forcerange)
    yield Change("actuator_forcerange", (ankles,), weaker, scales=True)


def _joints(model: mujoco.MjModel, params: EngineParams) -> Iterator[Change]:
    """Inertia and friction that the motors and gears bring into the joints."""
    joints = slice(6, None)
    yield Change("dof_armature", (joints,), params.armature_scale, 0.0, model.dof_armature[joints])
    yield Change("dof_frictionloss", (joints,), params.joint_friction, model.dof_frictionloss[joints], 1.0)
    yield Change("dof_damping", (joints,), params.joint_damping, model.dof_damping[joints], 1.0)


def _writes(change: Change, field: Tensor) -> Iterator[dict[str, Any]]:
    """Rows of :class:`Write`, one for each number that changes."""
    flat = field.view(field.shape[0], -1)
    fields = {str(dtype).removeprefix("torch."): flat.new_empty(0, 0, dtype=dtype) for dtype in PRECISIONS}
    fields[str(field.dtype).removeprefix("torch.")] = flat
    places = np.arange(flat.shape[1]).reshape(field.shape[1:])[change.where]
    bases, gains = (np.broadcast_to(np.asarray(values), places.shape).ravel() for values in (change.base, change.gain))
    params = change.param.view(flat.shape[0], -1).expand(-1, places.size).unbind(1)
    for param, place, base, gain in zip(params, places.ravel().tolist(), bases, gains, strict=True):
        write = {"param": param, "place": place, "base": float(base), "gain": float(gain)}
        yield write | {"inverse": int(change.inverse), "scales": int(change.scales)} | fields
