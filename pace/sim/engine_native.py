"""The native engine: MuJoCo C on all CPU cores, through MuJoCo's own batch of simulations."""

from __future__ import annotations

import os

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from pace.config import ConfigError, EngineConfig
from pace.sim.engine import ModelFields, StateTensors

_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)


class NativeEngine(StateTensors):
    """MuJoCo C in float64. ``mujoco.batch`` keeps a pool of threads, the warm start and each world's model fields.

    See :class:`~pace.sim.engine.RobotEngine`. Work on the host in proportion to the worlds concerned is allowed here.
    """

    def __init__(
        self, model: mujoco.MjModel, engine: EngineConfig, num_worlds: int, device: torch.device, substeps: int
    ) -> None:
        if device.type != "cpu":
            raise ConfigError(f"engine native runs on the CPU, not on {device}: use device=cpu or engine=mjwarp")
        super().__init__(model, num_worlds, device, substeps, engine.physics_dt)
        threads = engine.threads or len(os.sched_getaffinity(0))
        self._batch = batch = Batch(model, num_worlds, threads)
        self._fields = ModelFields(model, device)
        self._model = {name: torch.from_numpy(batch.expand(name)) for name in ModelFields.NAMES}
        self._qpos, self._qvel = torch.from_numpy(batch.bind("qpos")), torch.from_numpy(batch.bind("qvel"))
        self._warmstart = torch.from_numpy(batch.bind("qacc_warmstart"))
        self._control = np.zeros((num_worlds, substeps, model.nu + model.nv))
        control = torch.from_numpy(self._control)
        self._targets, self._applied = control[..., : model.nu], control[..., model.nu :]
        widths = {"qpos": model.nq, "qvel": model.nv, "sensordata": model.nsensordata, "actuator_force": model.nu}
        self._record = {name: np.zeros((num_worlds, substeps, width)) for name, width in widths.items()}
        recorded = {name: torch.from_numpy(array) for name, array in self._record.items()}
        self._new_qpos, self._new_qvel = recorded["qpos"], recorded["qvel"]
        self._sensordata, self._actuator_force = recorded["sensordata"][:, -1], recorded["actuator_force"][:, -1]
        self._qpos.copy_(self.qpos_path[:, 0])

    def advance(self, targets: Tensor, applied: Tensor) -> None:
        self._targets.copy_(targets)
        self._applied.copy_(applied.unsqueeze(1))
        self.qpos_path[:, 0].copy_(self._qpos)
        self.qvel_path[:, 0].copy_(self._qvel)
        self._batch.rollout(self.substeps, self._control, _CONTROL, tuple(self._record), out=self._record)
        self.qpos_path[:, 1:].copy_(self._new_qpos)
        self.qvel_path[:, 1:].copy_(self._new_qvel)
        self._read_sensors(self._sensordata, self._actuator_force)

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        ids = mask.nonzero().squeeze(-1)
        for state, path, values in ((self._qpos, self.qpos_path, qpos), (self._qvel, self.qvel_path, qvel)):
            chosen = values[ids]
            state[ids] = chosen.double()
            path[ids] = chosen.unsqueeze(1)
        for tensor in (self._warmstart, self.foot_force, self.body_contact, self.joint_torque):
            tensor[ids] = 0.0

    def apply_params(self, mask: Tensor) -> None:
        ids = mask.nonzero().squeeze(-1)
        for name, index, values in self._fields.writes(self.params.rows(ids)):
            self._model[name][:, *index][ids] = values.to(self._model[name].dtype)

    def add_velocity(self, delta: Tensor) -> None:
        self._qvel += delta

    def overflowed(self) -> bool:
        full = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]
        return bool(self._batch.warning[:, full, 1].any())  # mjWarningStat: last info, number

    def state_dict(self) -> dict[str, Tensor]:
        state = {"qpos": self._qpos, "qvel": self._qvel, "warmstart": self._warmstart}
        return state | self._outputs()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        for name, tensor in self.state_dict().items():
            tensor.copy_(state[name])
