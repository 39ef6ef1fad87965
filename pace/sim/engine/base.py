"""RobotEngine: the one contract that both physics engines meet, and the factory that chooses between them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Protocol

import mujoco
import torch
import warp as wp
from torch import Tensor

from pace.arrays.share import record, require_shape
from pace.config.base import ConfigError
from pace.sim.robot_spec import FEET


@dataclass(frozen=True)
class EngineParams:
    """Physical parameters of each world, float32, edited in place and put to work by ``apply_params``.

    Contact softness (``invweight0``) stays that of the nominal robot.
    """

    friction: Tensor  # (N,) sliding friction of every contact
    trunk_mass: Tensor  # (N,) kg added to the trunk, its inertia growing in proportion
    trunk_com: Tensor  # (N, 3) m added to the trunk's centre of mass, trunk frame
    kp_scale: Tensor  # (N,) of all joints
    kd_scale: Tensor  # (N,)
    armature_scale: Tensor  # (N,)
    effort_scale: Tensor  # (N,) of the effort and, where the motors know their speed, of the stall torque

    @classmethod
    def nominal(cls, model: mujoco.MjModel, num_worlds: int, device: torch.device) -> EngineParams:
        """The parameters with which every world is ``model`` itself."""
        values = dict.fromkeys((f.name for f in fields(cls)), 1.0)
        values |= {"friction": float(model.pair_friction[0, 0]), "trunk_mass": 0.0, "trunk_com": 0.0}
        shapes = {name: (num_worlds, 3) if name == "trunk_com" else (num_worlds,) for name in values}
        return cls(**{name: torch.full(shapes[name], value, device=device) for name, value in values.items()})


class RobotEngine(Protocol):
    """N worlds with one robot each. Tensors are float32 on ``device`` and the same objects for ever.

    Attributes:
        qpos_path, qvel_path: (N, S + 1, 7 + J) and (N, S + 1, 6 + J): the states at the S + 1 physics instants of the
            last control step, 0 its start and S its end. MuJoCo's conventions: quaternion w, x, y, z; linear velocity
            of the base in the world frame, its angular velocity in the body frame.
        foot_force: (N, 2, 3) N, world frame: net contact force on the left and right foot in the last physics step.
        body_contact: (N, B): 1 where that body of ``RobotSpec.contacts`` touched anything in the last physics step.
        joint_torque: (N, J) N m: what the motors gave in the last physics step.
        params: physical parameters of each world.
    """

    num_worlds: int
    device: torch.device
    substeps: int
    physics_dt: float
    params: EngineParams
    qpos_path: Tensor
    qvel_path: Tensor
    foot_force: Tensor
    body_contact: Tensor
    joint_torque: Tensor

    def advance(self, targets: Tensor, applied: Tensor) -> None:
        """Play one control step.

        Args: targets (N, S, J) rad: joint targets of each physics step; applied (N, 6 + J): generalized force (N, N m)
        held over the control step.
        """
        ...

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put the worlds of ``mask`` (N,) bool into the state qpos (N, 7 + J), qvel (N, 6 + J).

        Their whole path holds that state, their forces and contacts are zero, and the solver forgets its warm start.
        """
        ...

    def apply_params(self, mask: Tensor) -> None:
        """Give ``params`` to the models of the worlds of ``mask`` (N,) bool."""
        ...

    def add_velocity(self, delta: Tensor) -> None:
        """Add ``delta`` (N, 6 + J) to the velocities with which the next control step starts."""
        ...

    def overflowed(self) -> bool:
        """Whether a world ever had more contacts or constraints than there is room for. Waits for the device."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """All that the next control step depends on, besides ``params``: live tensors."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Put back what :meth:`state_dict` returned."""
        ...


class StateTensors:
    """The tensors that every engine shows, and their part in reset and resume."""

    def __init__(
        self, model: mujoco.MjModel, num_worlds: int, device: torch.device, substeps: int, physics_dt: float
    ) -> None:
        if num_worlds < 1:
            raise ConfigError(f"num_worlds must be at least 1, got {num_worlds}")
        if substeps < 1:
            raise ConfigError(f"substeps must be at least 1, got {substeps}")
        self.num_worlds, self.device, self.substeps, self.physics_dt = num_worlds, device, substeps, physics_dt
        self.params = EngineParams.nominal(model, num_worlds, device)
        self.qpos_path = torch.zeros(num_worlds, substeps + 1, model.nq, device=device)
        self.qvel_path = torch.zeros(num_worlds, substeps + 1, model.nv, device=device)
        self.foot_force = torch.zeros(num_worlds, FEET, 3, device=device)
        self.body_contact = torch.zeros(num_worlds, model.nsensordata - 3 * FEET, device=device)
        self.joint_torque = torch.zeros(num_worlds, model.nu, device=device)
        self.qpos_path.copy_(torch.as_tensor(model.key_qpos[0], dtype=torch.float32))
        self._mask = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self._start: tuple[Tensor | None, ...] = (None, None)

    def _solver_state(self) -> tuple[Tensor, Tensor, Tensor]:
        """qpos (N, 7 + J), qvel (N, 6 + J) and warm start (N, 6 + J) of the engine itself, in its precision."""
        raise NotImplementedError

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """See :class:`RobotEngine`. Give the same tensors each time: others are bound anew, which takes longer."""
        if self._start[0] is not qpos or self._start[1] is not qvel:
            self._bind_start(qpos, qvel)
        self._mask.copy_(mask)
        self._reset()

    def _bind_start(self, qpos: Tensor, qvel: Tensor) -> None:
        for name, state, path in (("qpos", qpos, self.qpos_path), ("qvel", qvel, self.qvel_path)):
            require_shape(name, state, (self.num_worlds, path.shape[2]))
        self._start = (qpos, qvel)
        tensors = (self._mask, qpos, qvel, *self._solver_state(), *self._outputs().values())
        self._reset = record(reset_state, self.num_worlds, [wp.from_torch(t) for t in tensors], self.device)

    def _outputs(self) -> dict[str, Tensor]:
        names = ("qpos_path", "qvel_path", "foot_force", "body_contact", "joint_torque")
        return {name: getattr(self, name) for name in names}

    def _read_sensors(self, sensordata: Tensor, actuator_force: Tensor) -> None:
        """Sensors of the scene: a force of 3 for each foot, then a number of contacts for each other body."""
        feet = self.foot_force.shape[1] * 3
        self.foot_force.view(self.num_worlds, feet).copy_(sensordata[:, :feet])
        self.body_contact.copy_(sensordata[:, feet:])
        self.body_contact.clamp_(max=1.0)
        self.joint_torque.copy_(actuator_force)


@wp.kernel
def reset_state(
    mask: wp.array[wp.bool],
    qpos: wp.array2d[wp.float32],
    qvel: wp.array2d[wp.float32],
    own_qpos: wp.array2d[Any],
    own_qvel: wp.array2d[Any],
    warmstart: wp.array2d[Any],
    qpos_path: wp.array3d[wp.float32],
    qvel_path: wp.array3d[wp.float32],
    foot_force: wp.array3d[wp.float32],
    body_contact: wp.array2d[wp.float32],
    joint_torque: wp.array2d[wp.float32],
):
    """Put a masked world into the state qpos, qvel: at rest in it through the whole path, touching nothing."""
    world = wp.tid()
    if not mask[world]:
        return
    for i in range(qpos.shape[1]):
        own_qpos[world, i] = own_qpos.dtype(qpos[world, i])
        for instant in range(qpos_path.shape[1]):
            qpos_path[world, instant, i] = qpos[world, i]
    for i in range(qvel.shape[1]):
        own_qvel[world, i] = own_qvel.dtype(qvel[world, i])
        warmstart[world, i] = warmstart.dtype(0.0)
        for instant in range(qvel_path.shape[1]):
            qvel_path[world, instant, i] = qvel[world, i]
    for foot in range(foot_force.shape[1]):
        for i in range(foot_force.shape[2]):
            foot_force[world, foot, i] = 0.0
    for i in range(body_contact.shape[1]):
        body_contact[world, i] = 0.0
    for i in range(joint_torque.shape[1]):
        joint_torque[world, i] = 0.0
