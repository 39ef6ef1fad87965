"""RobotEngine: the protocol of the physics engines, and their common base."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

import mujoco
import torch
import warp as wp
from torch import Tensor

from pace.arrays.launch import Bound, MaskedLaunch
from pace.arrays.state import Stateful
from pace.arrays.tensors import Float, Start, Vec3, allocate, named_tensors, struct_of
from pace.config.base import ConfigError
from pace.sim.robot_spec import FEET, TABLE_FORCES

Unit = Annotated[Float, Start(1.0)]


@dataclass(frozen=True)
class EngineParams:
    """Physical parameters of each world, float32, edited in place and put into effect by ``apply_params``.

    Contact softness (``invweight0``) remains that of the nominal robot.
    """

    friction: Float  # sliding friction of every contact
    trunk_mass: Float  # kg added to the trunk, its inertia growing in proportion
    trunk_com: Vec3  # m added to the trunk's centre of mass, trunk frame
    kp_scale: Unit  # of all joints
    kd_scale: Unit
    armature_scale: Unit
    effort_scale: Unit  # of the effort and, if the motors have a torque-speed line, of the stall torque
    speed_scale: Unit  # of the no-load speed of that line, at the same stall torque
    ankle_effort_scale: Unit  # times effort_scale, of the joints of the robot's group ``ankles``
    joint_friction: Float  # N m added to the dry friction of all joints
    joint_damping: Float  # N m s/rad, viscous friction added to all joints

    @classmethod
    def nominal(cls, model: mujoco.MjModel, num_worlds: int, device: torch.device) -> EngineParams:
        """The parameters with which every world equals ``model``."""
        params = allocate(cls, num_worlds, device)
        params.friction.fill_(float(model.pair_friction[0, 0]))
        return params


class RobotEngine(Protocol):
    """N worlds with one robot each. Tensors are float32 on ``device``, allocated once and updated in place.

    Attributes:
        qpos_path, qvel_path: (N, S + 1, 7 + J) and (N, S + 1, 6 + J): the states at the S + 1 physics instants of the
            last control step, 0 its start and S its end. MuJoCo's conventions: quaternion w, x, y, z; linear velocity
            of the base in the world frame, its angular velocity in the body frame.
        foot_force: (N, 2, 3) N, world frame: net contact force on the left and right foot in the last physics step.
        body_contact: (N, B): 1 if that body of ``RobotSpec.contacts`` touched anything in the last physics step.
        joint_torque: (N, J) N m: of the motors in the last physics step.
        table_force: (N, S, T, 3) N, world frame: net contact force of the table on the robot in each of the S physics
            steps; on the whole robot and, if ``robot.free_hand`` names one (T = 2), on its free hand.
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
    table_force: Tensor

    def advance(self, targets: Tensor, applied: Tensor) -> None:
        """Simulate one control step.

        Args: targets (N, S, J) rad: joint targets of each physics step; applied (N, 6 + J): generalized force (N, N m)
        held over the control step.
        """
        ...

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put the worlds of ``mask`` (N,) bool into the state qpos (N, 7 + J), qvel (N, 6 + J).

        Their whole path holds that state, their forces and contacts are zero, and the solver's warm start is cleared.
        """
        ...

    def apply_params(self, mask: Tensor) -> None:
        """Give ``params`` to the models of the worlds of ``mask`` (N,) bool."""
        ...

    def add_velocity(self, delta: Tensor) -> None:
        """Add ``delta`` (N, 6 + J) to the velocities with which the next control step starts."""
        ...

    def overflowed(self) -> bool:
        """Whether a world ever had more contacts or constraints than the memory holds. Waits for the device."""
        ...

    def state_tensors(self) -> dict[str, Tensor]:
        """All tensors that the next control step depends on, besides ``params``."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of them."""
        ...

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Load the result of :meth:`state_dict`."""
        ...


@dataclass(eq=False)
class EngineState:
    """The public tensors of an engine: see :class:`RobotEngine`."""

    qpos_path: Annotated[Float, "instants", "nq"]
    qvel_path: Annotated[Float, "instants", "nv"]
    foot_force: Annotated[Vec3, "feet"]
    body_contact: Annotated[Float, "bodies"]
    joint_torque: Annotated[Float, "joints"]


@struct_of(EngineState)
class EngineArrays:
    """:class:`EngineState` in the kernels' form."""


class StateTensors(EngineState, Stateful):
    """The public tensors of an engine, and their part in reset and resume."""

    def __init__(
        self, model: mujoco.MjModel, num_worlds: int, device: torch.device, substeps: int, physics_dt: float
    ) -> None:
        if num_worlds < 1:
            raise ConfigError(f"num_worlds must be at least 1, got {num_worlds}")
        if substeps < 1:
            raise ConfigError(f"substeps must be at least 1, got {substeps}")
        self.num_worlds, self.device, self.substeps, self.physics_dt = num_worlds, device, substeps, physics_dt
        self.params = EngineParams.nominal(model, num_worlds, device)
        touches = sum(model.sensor(i).name in TABLE_FORCES for i in range(model.nsensor))
        sizes = {"feet": FEET, "bodies": model.nsensordata - 3 * (FEET + touches), "joints": model.nu}
        sizes |= {"instants": substeps + 1, "nq": model.nq, "nv": model.nv}
        super().__init__(**vars(allocate(EngineState, num_worlds, device, **sizes)))
        self.table_force = torch.zeros(
            num_worlds, substeps, touches, 3, device=device
        )  # of each step: no part of the state
        self.qpos_path.copy_(torch.as_tensor(model.key_qpos[0], dtype=torch.float32))
        starts = {"qpos": (num_worlds, model.nq), "qvel": (num_worlds, model.nv)}
        self._reset = Bound(self._record_reset, **starts)

    def _solver_state(self) -> dict[str, Tensor]:
        """qpos (N, 7 + J), qvel and warmstart (N, 6 + J) of the engine, in its precision."""
        raise NotImplementedError

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """See :class:`RobotEngine`. Give the same tensors each time: others are bound again, which takes longer."""
        self._reset(qpos, qvel)(mask)

    def _record_reset(self, qpos: Tensor, qvel: Tensor) -> MaskedLaunch:
        own = {f"own_{name}": tensor for name, tensor in self._solver_state().items()}
        return MaskedLaunch(reset_state, self.num_worlds, self.device, qpos=qpos, qvel=qvel, state=self, **own)

    def state_tensors(self) -> dict[str, Tensor]:
        return self._solver_state() | named_tensors(self)

    def _read_sensors(self, sensordata: Tensor, actuator_force: Tensor) -> None:
        """Sensors of the scene: a force of 3 for each foot, a number of contacts for each other body, forces on the
        table, which the engine reads in each physics step."""
        feet = self.foot_force.shape[1] * 3
        self.foot_force.view(self.num_worlds, feet).copy_(sensordata[:, :feet])
        self.body_contact.copy_(sensordata[:, feet : feet + self.body_contact.shape[1]])
        self.body_contact.clamp_(max=1.0)
        self.joint_torque.copy_(actuator_force)


@wp.kernel
def reset_state(
    mask: wp.array[wp.bool],
    qpos: wp.array2d[wp.float32],
    qvel: wp.array2d[wp.float32],
    own_qpos: wp.array2d[Any],
    own_qvel: wp.array2d[Any],
    own_warmstart: wp.array2d[Any],
    state: EngineArrays,
):
    """Put a masked world into the state qpos, qvel: at rest in it through the whole path, touching nothing."""
    world = wp.tid()
    if not mask[world]:
        return
    for i in range(qpos.shape[1]):
        own_qpos[world, i] = own_qpos.dtype(qpos[world, i])
        for instant in range(state.qpos_path.shape[1]):
            state.qpos_path[world, instant, i] = qpos[world, i]
    for i in range(qvel.shape[1]):
        own_qvel[world, i] = own_qvel.dtype(qvel[world, i])
        own_warmstart[world, i] = own_warmstart.dtype(0.0)
        for instant in range(state.qvel_path.shape[1]):
            state.qvel_path[world, instant, i] = qvel[world, i]
    for foot in range(state.foot_force.shape[1]):
        state.foot_force[world, foot] = wp.vec3()
    for i in range(state.body_contact.shape[1]):
        state.body_contact[world, i] = 0.0
    for i in range(state.joint_torque.shape[1]):
        state.joint_torque[world, i] = 0.0
