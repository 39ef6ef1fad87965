"""Poses and velocities of paddle, feet and head from the robot's state, and the paddle's Jacobian transpose.

MuJoCo's own ``xpos`` and sensors are one physics step older than the state after ``mj_step``. These kernels use the
states themselves, so that paddle path and state belong to the same instants with either engine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import mujoco
import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from pace.arrays.launch import Bound, Launch, MaskedLaunch
from pace.arrays.tensors import Float, Vec3, allocate, struct_of
from pace.sim.robot_spec import FEET
from pace.sim.robot_state import Feet

#: The tips, in the order of the chains (``RobotSpec.tips``).
PADDLE, LEFT_FOOT, HEAD = wp.constant(0), wp.constant(1), wp.constant(3)


@dataclass(eq=False)
class Tips:
    """Paddle, feet and head of N worlds, world frame."""

    #: (N, S + 1, 12): centre (m), unit normal (the link's x axis), linear velocity of the centre (m/s), angular
    #: velocity (rad/s) at the S + 1 instants of the control step
    paddle_path: Annotated[Float, "instants", "columns"]
    foot_position: Feet  # m, centre of the sole; this and the following at the end of the control step
    foot_velocity: Feet  # m/s
    foot_up: Feet  # unit vector, the foot's z axis
    head_position: Vec3  # m


@struct_of(Tips)
class TipArrays:
    """:class:`Tips` in the kernels' form."""


@dataclass(eq=False)
class Mount:
    """Where the paddle of each of N worlds is, in its link: that of the model at ``offset`` 0 and ``normal`` x."""

    offset: Vec3  # m, of the centre from the model's paddle site
    normal: Vec3  # unit vector


@struct_of(Mount)
class MountArrays:
    """:class:`Mount` in the kernels' form."""


@wp.struct
class Chains:
    """Kinematic chains from the base to each tip: the joints of chain c are links start[c] to start[c + 1] - 1."""

    start: wp.array[wp.int32]
    joint: wp.array[wp.int32]  # index into RobotSpec.joints
    offset: wp.array[wp.vec3]  # m, joint's origin in the frame before it
    orientation: wp.array[wp.quat]  # of the joint's frame in the frame before it, at angle 0
    axis: wp.array[wp.vec3]
    tip_offset: wp.array[wp.vec3]  # m, in the last link's frame


@wp.struct
class Frame:
    """Pose and velocity of a point of a link, world frame."""

    position: wp.vec3
    rotation: wp.quat
    velocity: wp.vec3
    angular_velocity: wp.vec3


@wp.func
def _quat(w: float, x: float, y: float, z: float) -> wp.quat:
    return wp.normalize(wp.quat(x, y, z, w))


@wp.func
def _base(qpos: wp.array[float], qvel: wp.array[float]) -> Frame:
    frame = Frame()
    frame.position = wp.vec3(qpos[0], qpos[1], qpos[2])
    frame.rotation = _quat(qpos[3], qpos[4], qpos[5], qpos[6])
    frame.velocity = wp.vec3(qvel[0], qvel[1], qvel[2])
    # MuJoCo keeps a free joint's angular velocity in the body frame
    frame.angular_velocity = wp.quat_rotate(frame.rotation, wp.vec3(qvel[3], qvel[4], qvel[5]))
    return frame


@wp.func
def _moved(frame: Frame, offset: wp.vec3) -> Frame:
    """The same link at another point, ``offset`` in the link's frame."""
    lever = wp.quat_rotate(frame.rotation, offset)
    frame.position += lever
    frame.velocity += wp.cross(frame.angular_velocity, lever)
    return frame


@wp.func
def _link(chains: Chains, link: int, frame: Frame, angle: float, rate: float) -> Frame:
    """The frame of the link after the joint ``link``."""
    frame = _moved(frame, chains.offset[link])
    rotation = frame.rotation * chains.orientation[link]
    axis = chains.axis[link]
    frame.angular_velocity += wp.quat_rotate(rotation, axis) * rate
    frame.rotation = rotation * wp.quat_from_axis_angle(axis, angle)
    return frame


@wp.func
def _tip(chains: Chains, chain: int, base: Frame, qpos: wp.array[float], qvel: wp.array[float]) -> Frame:
    frame = base
    for link in range(chains.start[chain], chains.start[chain + 1]):
        joint = chains.joint[link]
        frame = _link(chains, link, frame, qpos[7 + joint], qvel[6 + joint])
    return _moved(frame, chains.tip_offset[chain])


@wp.func
def _store(row: wp.array[float], start: int, value: wp.vec3):
    for i in range(3):
        row[start + i] = value[i]


@wp.kernel
def _update(
    mask: wp.array[wp.bool],
    chains: Chains,
    mount: MountArrays,
    qpos_path: wp.array3d[float],
    qvel_path: wp.array3d[float],
    tips: TipArrays,
):
    """One item of one masked world: the paddle at each instant of the path, then both feet and the head at its end."""
    world, item = wp.tid()
    if not mask[world]:
        return
    instants = qpos_path.shape[1]
    instant = wp.min(item, instants - 1)
    chain = wp.max(item - instants + 1, PADDLE)
    qpos = qpos_path[world, instant]
    qvel = qvel_path[world, instant]
    tip = _tip(chains, chain, _base(qpos, qvel), qpos, qvel)
    if chain == PADDLE:
        tip = _moved(tip, mount.offset[world])
        row = tips.paddle_path[world, instant]
        _store(row, 0, tip.position)
        _store(row, 3, wp.quat_rotate(tip.rotation, mount.normal[world]))
        _store(row, 6, tip.velocity)
        _store(row, 9, tip.angular_velocity)
    elif chain == HEAD:
        tips.head_position[world] = tip.position
    else:
        foot = chain - LEFT_FOOT
        tips.foot_position[world, foot] = tip.position
        tips.foot_velocity[world, foot] = tip.velocity
        tips.foot_up[world, foot] = wp.quat_rotate(tip.rotation, wp.vec3(0.0, 0.0, 1.0))


@wp.kernel
def _paddle_jacobian_transpose(
    chains: Chains,
    qpos_path: wp.array3d[float],
    qvel_path: wp.array3d[float],
    force: wp.array2d[float],
    point: wp.array2d[float],
    out: wp.array2d[float],
):
    """Generalized force of a force on the paddle's link, at the end of the path."""
    world = wp.tid()
    row = out[world]
    for dof in range(row.shape[0]):
        row[dof] = 0.0
    push = wp.vec3(force[world, 0], force[world, 1], force[world, 2])
    if push == wp.vec3():  # no ball on the blade: nearly always
        return
    last = qpos_path.shape[1] - 1
    qpos = qpos_path[world, last]
    frame = _base(qpos, qvel_path[world, last])
    at = wp.vec3(point[world, 0], point[world, 1], point[world, 2])
    _store(row, 0, push)
    _store(row, 3, wp.quat_rotate_inv(frame.rotation, wp.cross(at - frame.position, push)))
    for link in range(chains.start[PADDLE], chains.start[PADDLE + 1]):
        joint = chains.joint[link]
        frame = _link(chains, link, frame, qpos[7 + joint], 0.0)
        # the joint's axis is the same before and after its own rotation
        axis = wp.quat_rotate(frame.rotation, chains.axis[link])
        row[6 + joint] = wp.dot(axis, wp.cross(at - frame.position, push))


def _chain(model: mujoco.MjModel, site: str) -> tuple[list[tuple[int, NDArray, NDArray, NDArray]], NDArray]:
    """Joints (index, offset, quat wxyz, axis) from the base to a site, and the site in the last joint's frame."""
    body = int(model.site(site).bodyid[0])
    path: list[int] = []
    while model.body_parentid[body] != 0:
        path.insert(0, body)
        body = int(model.body_parentid[body])
    joints, offset, quat = [], np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    for body in path:
        mujoco.mju_mulPose(offset, quat, offset.copy(), quat.copy(), model.body_pos[body], model.body_quat[body])
        if model.body_jntnum[body]:
            joint = int(model.body_jntadr[body])
            joints.append((joint - 1, offset.copy(), quat.copy(), model.jnt_axis[joint]))
            offset, quat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    tip, unused = np.zeros(3), np.zeros(4)
    mujoco.mju_mulPose(tip, unused, offset, quat, model.site(site).pos, np.array([1.0, 0.0, 0.0, 0.0]))
    return joints, tip


def _build_chains(model: mujoco.MjModel, tips: Sequence[str], device: wp.Device) -> Chains:
    if np.any(model.jnt_pos[1:]):
        raise ValueError("kinematics needs every joint at the origin of its body (joint pos 0 0 0)")
    parts = [_chain(model, tip) for tip in tips]
    links = [link for joints, _ in parts for link in joints]
    chains = Chains()
    chains.start = wp.array(np.cumsum([0, *(len(joints) for joints, _ in parts)]), dtype=wp.int32, device=device)
    chains.joint = wp.array([link[0] for link in links], dtype=wp.int32, device=device)
    chains.offset = wp.array([link[1] for link in links], dtype=wp.vec3, device=device)
    # MuJoCo writes w, x, y, z and Warp x, y, z, w
    chains.orientation = wp.array([np.roll(link[2], -1) for link in links], dtype=wp.quat, device=device)
    chains.axis = wp.array([link[3] for link in links], dtype=wp.vec3, device=device)
    chains.tip_offset = wp.array([tip for _, tip in parts], dtype=wp.vec3, device=device)
    return chains


class Kinematics(Tips):
    """Paddle path, feet and head of N worlds, from the state path of a :class:`~pace.sim.engine.base.RobotEngine`.

    Its attributes are those of :class:`Tips`, allocated once and overwritten by :meth:`update`.
    """

    def __init__(
        self, model: mujoco.MjModel, tips: Sequence[str], num_worlds: int, substeps: int, device: torch.device | str
    ) -> None:
        self._device, self._num_tips = torch.device(device), len(tips)
        self._chains = _build_chains(model, tips, wp.device_from_torch(self._device))
        self._num_worlds = num_worlds
        #: Where the paddles are; edited in place.
        self.mount = allocate(Mount, num_worlds, device)
        self.mount.normal[:, 0] = 1.0
        super().__init__(**vars(allocate(Tips, num_worlds, device, instants=substeps + 1, columns=12, feet=FEET)))
        self._path: tuple[Tensor, Tensor] | None = None
        n, instants = num_worlds, substeps + 1
        paths = {"qpos_path": (n, instants, model.nq), "qvel_path": (n, instants, model.nv)}
        self._update = Bound(self._record_update, **paths)
        self._push = Bound(self._record_push, **paths, force=(n, 3), point=(n, 3), out=(n, model.nv))

    def update(self, qpos_path: Tensor, qvel_path: Tensor, mask: Tensor | None = None) -> None:
        """Fill the attributes from qpos (N, S + 1, 7 + J) and qvel (N, S + 1, 6 + J).

        ``mask`` (N,) bool: the worlds in which they are new; ``None``: all. The path is remembered:
        :meth:`paddle_generalized_force` uses its end.
        """
        self._update(qpos_path, qvel_path)(mask)

    def _record_update(self, qpos_path: Tensor, qvel_path: Tensor) -> MaskedLaunch:
        self._path = (qpos_path, qvel_path)
        worlds, instants, _ = self.paddle_path.shape
        given = {"chains": self._chains, "mount": self.mount, "qpos_path": qpos_path, "qvel_path": qvel_path}
        return MaskedLaunch(_update, (worlds, instants + self._num_tips - 1), self._device, tips=self, **given)

    def paddle_generalized_force(self, force: Tensor, point: Tensor, out: Tensor) -> None:
        """Write J^T f of a force on the paddle's link into ``out`` (N, 6 + J), for the end of the path last given.

        Args: force (N, 3) N and its point of action (N, 3) m, world frame. Give the same tensors each time: others are
        bound again, which takes longer.
        Errors: RuntimeError before the first :meth:`update`.
        """
        if self._path is None:
            raise RuntimeError("paddle_generalized_force needs the robot's state: call update() first")
        self._push(*self._path, force, point, out)()

    def _record_push(self, qpos_path: Tensor, qvel_path: Tensor, force: Tensor, point: Tensor, out: Tensor) -> Launch:
        state = {"chains": self._chains, "qpos_path": qpos_path, "qvel_path": qvel_path}
        push = {"force": force, "point": point, "out": out}
        return Launch(_paddle_jacobian_transpose, self._num_worlds, self._device, **state, **push)
