"""The native engine: MuJoCo C on all CPU cores, through MuJoCo's own batch of simulations."""

from __future__ import annotations

import copy
import ctypes
from contextlib import suppress

import mujoco
import numpy as np
import torch
from mujoco import _batch
from mujoco.batch import Batch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.sim import EngineConfig
from pace.cores import usable_cores
from pace.sim.engine.base import StateTensors
from pace.sim.engine.model_fields import ModelFields

#: Inputs of a rollout: targets, then generalized forces.
CONTROL = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)


class NativeEngine(StateTensors):
    """MuJoCo C in float64. ``mujoco.batch`` keeps a pool of threads, the warm start and each world's model fields.

    See :class:`~pace.sim.engine.base.RobotEngine`. Host work proportional to the number of masked worlds is allowed
    here.
    """

    def __init__(
        self, model: mujoco.MjModel, engine: EngineConfig, num_worlds: int, device: torch.device, substeps: int
    ) -> None:
        if device.type != "cpu":
            raise ConfigError(f"engine native runs on the CPU, not on {device}: use device=cpu or engine=mjwarp")
        super().__init__(model, num_worlds, device, substeps, engine.physics_dt)
        stop_timers()
        mujoco.set_mju_user_warning(_ignore)
        model = copy.copy(model)
        # a state that is not finite stays so and is detected; MuJoCo would reset that robot silently
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._batch = batch = Batch(model, num_worlds, engine.threads or usable_cores())
        fields = {name: torch.from_numpy(batch.expand(name)) for name in ModelFields.NAMES}
        self._fields = ModelFields(model, self.params, fields)
        self._qpos, self._qvel = batch.bind("qpos"), batch.bind("qvel")
        self._warmstart = batch.bind("qacc_warmstart")
        self._control = np.zeros((num_worlds, substeps, model.nu + model.nv))
        self._targets, self._applied = self._control[..., : model.nu], self._control[..., model.nu :]
        widths = {"qpos": model.nq, "qvel": model.nv, "sensordata": model.nsensordata, "actuator_force": model.nu}
        self._record = {name: np.zeros((num_worlds, substeps, width)) for name, width in widths.items()}
        self._sensordata = torch.from_numpy(self._record["sensordata"])[:, -1]
        self._actuator_force = torch.from_numpy(self._record["actuator_force"])[:, -1]
        self._on_table = self._record["sensordata"][..., model.nsensordata - 3 * self.table_force.shape[2] :]
        self._table_force = self.table_force.numpy().reshape(self._on_table.shape)
        # NumPy copies: torch's would wake torch's threads beside the pool's, which costs milliseconds on busy cores
        self._paths = {"qpos": self.qpos_path.numpy(), "qvel": self.qvel_path.numpy()}
        self._qpos[:] = self._paths["qpos"][:, 0]

    def advance(self, targets: Tensor, applied: Tensor) -> None:
        self._targets[:] = targets.numpy()
        self._applied[:] = applied.numpy()[:, None]
        self._paths["qpos"][:, 0] = self._qpos
        self._paths["qvel"][:, 0] = self._qvel
        self._roll_out()
        for name, path in self._paths.items():
            path[:, 1:] = self._record[name]
        self._table_force[:] = self._on_table
        self._read_sensors(self._sensordata, self._actuator_force)

    def _roll_out(self) -> None:
        """Simulate the physics steps of one control step, and record them."""
        self._batch.rollout(self.substeps, self._control, CONTROL, tuple(self._record), out=self._record)

    def _solver_state(self) -> dict[str, Tensor]:
        state = {"qpos": self._qpos, "qvel": self._qvel, "warmstart": self._warmstart}
        return {name: torch.from_numpy(array) for name, array in state.items()}

    def apply_params(self, mask: Tensor) -> None:
        self._fields.write(mask)

    def add_velocity(self, delta: Tensor) -> None:
        self._qvel += delta.numpy()

    def overflowed(self) -> bool:
        full = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]
        return bool(self._batch.warning[:, full, 1].any())  # mjWarningStat: last info, number


def _ignore(_: str) -> None:
    """In place of MuJoCo's warnings, which it prints, and appends to a file in the user's folder.

    Divergence and full buffers are seen without them: :class:`pace.sim.divergence.Divergence`, ``overflowed``.
    """


def stop_timers() -> None:
    """Stop MuJoCo's timing in this process: its Python module times every part of every step, which costs 5 %.

    ``MjData.timer`` stays zero from then on. A module without an accessible hook keeps its clock.
    """
    # mujoco.set_mjcb_time(None) only restores the module's default clock
    with suppress(ValueError):
        ctypes.c_void_p.in_dll(ctypes.CDLL(_batch.__file__), "mjcb_time").value = None
