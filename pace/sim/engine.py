"""RobotEngine: the one contract that both physics engines meet, and the factory that chooses between them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol

import mujoco
import torch
import warp as wp
from torch import Tensor

from pace.config import ConfigError, EngineConfig
from pace.sim.engine_kernels import reset_state
from pace.sim.graph import graphs_wanted
from pace.sim.robot import FEET
from pace.sim.sharing import record, require_shape


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
        qpos_path, qvel_path: (N, S + 1, 28) and (N, S + 1, 27): the states at the S + 1 physics instants of the last
            control step, 0 its start and S its end. MuJoCo's conventions: quaternion w, x, y, z; linear velocity of
            the base in the world frame, its angular velocity in the body frame.
        foot_force: (N, 2, 3) N, world frame: net contact force on the left and right foot in the last physics step.
        body_contact: (N, len(CONTACT_BODIES)): 1 where that body touched anything in the last physics step.
        joint_torque: (N, 21) N m: what the motors gave in the last physics step.
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

        Args: targets (N, S, 21) rad: joint targets of each physics step; applied (N, 27): generalized force (N, N m)
        held over the control step.
        """
        ...

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put the worlds of ``mask`` (N,) bool into the state qpos (N, 28), qvel (N, 27).

        Their whole path holds that state, their forces and contacts are zero, and the solver forgets its warm start.
        """
        ...

    def apply_params(self, mask: Tensor) -> None:
        """Give ``params`` to the models of the worlds of ``mask`` (N,) bool."""
        ...

    def add_velocity(self, delta: Tensor) -> None:
        """Add ``delta`` (N, 27) to the velocities with which the next control step starts."""
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
        self.foot_force = torch.zeros(num_worlds, len(FEET), 3, device=device)
        self.body_contact = torch.zeros(num_worlds, model.nsensordata - 3 * len(FEET), device=device)
        self.joint_torque = torch.zeros(num_worlds, model.nu, device=device)
        self.qpos_path.copy_(torch.as_tensor(model.key_qpos[0], dtype=torch.float32))
        self._mask = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self._start: tuple[Tensor | None, ...] = (None, None)

    def _solver_state(self) -> tuple[Tensor, Tensor, Tensor]:
        """qpos (N, 28), qvel (N, 27) and warm start (N, 27) of the engine itself, in its precision."""
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


def resolve_device(device: str | torch.device) -> torch.device:
    """``auto``, ``cpu``, ``cuda`` or ``cuda:1`` as a torch device; ``auto`` is the first GPU, or the CPU without one.

    Errors: :class:`ConfigError` for a device that is unknown, or not there.
    """
    if str(device) == "auto":
        return torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    try:
        resolved = torch.device(device)
    except RuntimeError as error:
        raise ConfigError(f"device must be auto, cpu, cuda or cuda:<number>, not {device!r}") from error
    if resolved.type not in ("cpu", "cuda"):
        raise ConfigError(f"device must be auto, cpu, cuda or cuda:<number>, not {str(device)!r}")
    if resolved.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (resolved.index or 0) >= count:
            raise ConfigError(f"device {device} is not there: torch sees {count} GPU(s); use device=cpu")
        return torch.device("cuda", resolved.index or 0)
    return torch.device("cpu")


def make_engine(
    model: mujoco.MjModel, engine: EngineConfig, num_worlds: int, device: str | torch.device, substeps: int
) -> RobotEngine:
    """N worlds of ``model`` on ``device``. Engine ``auto`` is mjwarp on a GPU and native on the CPU.

    Args: substeps: physics steps of one control step. The worlds stand in the model's nominal keyframe.
    Errors: :class:`ConfigError` for a device that is not there, or that the engine or CUDA graphs cannot use.
    """
    where = resolve_device(device)
    graphs_wanted(engine, where)
    name = engine.name if engine.name != "auto" else ("mjwarp" if where.type == "cuda" else "native")
    if name == "native":
        from pace.sim.engine_native import NativeEngine

        return NativeEngine(model, engine, num_worlds, where, substeps)
    from pace.sim.engine_mjwarp import MjwarpEngine  # loads MuJoCo Warp, which takes seconds

    return MjwarpEngine(model, engine, num_worlds, where, substeps)
