"""The MuJoCo Warp engine: thousands of worlds on a GPU, and the same code on Warp's CPU device for tests."""

from __future__ import annotations

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

from pace.arrays.graph import CapturedCall, Graphs, RecordedLaunches, graphs_of
from pace.arrays.launch import Launch
from pace.arrays.streams import warp_scope
from pace.config.sim import EngineConfig
from pace.sim.engine.base import StateTensors
from pace.sim.engine.model_fields import ModelFields

#: Overflows that drop contacts or constraints. The solver's iteration limits, which share the bit mask, do not.
_DROPPED = (
    mjw.OverflowType.NEFC
    | mjw.OverflowType.NJMAX_NNZ
    | mjw.OverflowType.BROADPHASE
    | mjw.OverflowType.NARROWPHASE
    | mjw.OverflowType.CCD
    | mjw.OverflowType.CONTACT_MATCH
)


@wp.kernel
def _load_targets(targets: wp.array3d[float], step: int, ctrl: wp.array2d[float]):
    world, joint = wp.tid()
    ctrl[world, joint] = targets[world, step, joint]


@wp.kernel
def _record_state(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    sensordata: wp.array2d[float],
    instant: int,
    qpos_path: wp.array3d[float],
    qvel_path: wp.array3d[float],
    table_force: wp.array3d[wp.vec3],
):
    """The state at an instant, and the forces on the table in the physics step that led to it."""
    world = wp.tid()
    touches = table_force.shape[2]
    for touch in range(wp.where(instant > 0, touches, 0)):
        at = sensordata.shape[1] - 3 * (touches - touch)
        force = wp.vec3(sensordata[world, at], sensordata[world, at + 1], sensordata[world, at + 2])
        table_force[world, instant - 1, touch] = force
    for i in range(qpos.shape[1]):
        qpos_path[world, instant, i] = qpos[world, i]
    for i in range(qvel.shape[1]):
        qvel_path[world, instant, i] = qvel[world, i]


class MjwarpEngine(StateTensors):
    """MuJoCo Warp in float32. See :class:`~pace.sim.engine.base.RobotEngine`.

    On a GPU one control step is one CUDA graph, or a part of the environment's (``CapturedCall``).
    On a CPU its launches are recorded (``RecordedLaunches``). Both hold the addresses of the
    arrays and the options of the second step: edit values in place, and replace no array of ``model`` or ``data``.
    """

    def __init__(
        self, model: mujoco.MjModel, engine: EngineConfig, num_worlds: int, device: torch.device, substeps: int
    ) -> None:
        super().__init__(model, num_worlds, device, substeps, engine.physics_dt)
        graphs = graphs_of(engine, device)
        with warp_scope(device):
            self.model = mjw.put_model(model, batch_sizes=dict.fromkeys(ModelFields.NAMES, num_worlds))
            # Two boxes (trunk and table) then meet by MuJoCo's own test for boxes, as on the other engine, and not by
            # the general convex algorithm, which finds other points. Nothing else depends on the flag (engines.md).
            self.model.opt.disableflags |= mjw.DisableBit.NATIVECCD
            order = mjw.DeterminismType.ALL if engine.deterministic else mjw.DeterminismType.NONE
            self.model.opt.deterministic = int(order)
            self.model.opt.warn_overflow = 0  # would print a line per world and step; overflowed() reports it instead
            # On a GPU all iterations are launched, and converged worlds skip theirs: a loop that ends on the device
            # would interrupt the capture around it, and torch would lose track of the graph's memory.
            self.model.opt.graph_conditional = graphs is Graphs.NONE and device.type == "cpu"
            self.data = mjw.make_data(
                model, num_worlds, nconmax=engine.contacts_per_world, njmax=engine.constraints_per_world
            )
        fields = {name: wp.to_torch(getattr(self.model, name)) for name in ModelFields.NAMES}
        self._fields = ModelFields(model, self.params, fields)
        data = self.data
        self._qpos, self._qvel = wp.to_torch(data.qpos), wp.to_torch(data.qvel)
        self._warmstart, self._applied = wp.to_torch(data.qacc_warmstart), wp.to_torch(data.qfrc_applied)
        self._sensordata, self._actuator_force = wp.to_torch(data.sensordata), wp.to_torch(data.actuator_force)
        self._overflow = wp.to_torch(data.overflow)
        self._targets = torch.zeros(num_worlds, substeps, model.nu, device=device)
        self._load = [self._load_targets(step) for step in range(substeps)]
        self._note = [self._record_state(instant) for instant in range(substeps + 1)]
        if device.type == "cuda" or graphs is Graphs.DRY:
            self._step = CapturedCall(self._play, device, graphs)
        else:
            self._step = RecordedLaunches(self._play, engine.graph != "never")
        self._qpos.copy_(self.qpos_path[:, 0])

    def advance(self, targets: Tensor, applied: Tensor) -> None:
        self._targets.copy_(targets)
        self._applied.copy_(applied)
        self._step()
        self._read_sensors(self._sensordata, self._actuator_force)

    def _play(self) -> None:
        """The launches of one control step."""
        with warp_scope(self.device):
            self._note[0]()
            for load, note in zip(self._load, self._note[1:], strict=True):
                load()
                mjw.step(self.model, self.data)
                note()

    def _load_targets(self, step: int) -> Launch:
        ctrl = self.data.ctrl
        return Launch(_load_targets, ctrl.shape, self.device, targets=self._targets, step=step, ctrl=ctrl)

    def _record_state(self, instant: int) -> Launch:
        data, table = self.data, self.table_force
        given = {"qpos": data.qpos, "qvel": data.qvel, "sensordata": data.sensordata}
        paths = {"qpos_path": self.qpos_path, "qvel_path": self.qvel_path, "table_force": table}
        return Launch(_record_state, self.num_worlds, self.device, instant=instant, **given, **paths)

    def _solver_state(self) -> dict[str, Tensor]:
        return {"qpos": self._qpos, "qvel": self._qvel, "warmstart": self._warmstart}

    def apply_params(self, mask: Tensor) -> None:
        self._fields.write(mask)

    def add_velocity(self, delta: Tensor) -> None:
        self._qvel += delta

    def overflowed(self) -> bool:
        return bool((self._overflow & int(_DROPPED)).any())
