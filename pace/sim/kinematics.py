"""Poses and velocities of paddle, feet and head from the robot's state, and the paddle's Jacobian transpose.

MuJoCo's own ``xpos`` and sensors are one physics step older than the state after ``mj_step``. These kernels use the
states themselves, so that paddle path and state belong to the same instants with either engine.
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from pace.arrays.share import record
from pace.sim.robot import FEET

#: The tips, in the order of the chains: sites of the model.
TIPS = ("paddle", *FEET, "head")
PADDLE, LEFT_FOOT, HEAD = wp.constant(0), wp.constant(1), wp.constant(3)


@wp.struct
class Chains:
    """Kinematic chains from the base to each tip: the joints of chain c are links start[c] to start[c + 1] - 1."""

    start: wp.array[wp.int32]
    joint: wp.array[wp.int32]  # index into JOINT_NAMES
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
    """The same link at another of its points, ``offset`` in its own frame."""
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
    masked: int,
    chains: Chains,
    qpos_path: wp.array3d[float],
    qvel_path: wp.array3d[float],
    paddle_path: wp.array3d[float],
    foot_position: wp.array3d[float],
    foot_velocity: wp.array3d[float],
    foot_up: wp.array3d[float],
    head_position: wp.array2d[float],
):
    """One item of one world: the paddle at each instant of the path, then both feet and the head at its end.

    With ``masked`` of the masked worlds only.
    """
    world, item = wp.tid()
    if masked == 1 and not mask[world]:
        return
    instants = qpos_path.shape[1]
    instant = wp.min(item, instants - 1)
    chain = wp.max(item - instants + 1, PADDLE)
    qpos = qpos_path[world, instant]
    qvel = qvel_path[world, instant]
    tip = _tip(chains, chain, _base(qpos, qvel), qpos, qvel)
    if chain == PADDLE:
        row = paddle_path[world, instant]
        _store(row, 0, tip.position)
        _store(row, 3, wp.quat_rotate(tip.rotation, wp.vec3(1.0, 0.0, 0.0)))
        _store(row, 6, tip.velocity)
        _store(row, 9, tip.angular_velocity)
    elif chain == HEAD:
        _store(head_position[world], 0, tip.position)
    else:
        foot = chain - LEFT_FOOT
        _store(foot_position[world, foot], 0, tip.position)
        _store(foot_velocity[world, foot], 0, tip.velocity)
        _store(foot_up[world, foot], 0, wp.quat_rotate(tip.rotation, wp.vec3(0.0, 0.0, 1.0)))


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


def _build_chains(model: mujoco.MjModel, device: wp.Device) -> Chains:
    if np.any(model.jnt_pos[1:]):
        raise ValueError("kinematics wants every joint at the origin of its body (joint pos 0 0 0)")
    parts = [_chain(model, tip) for tip in TIPS]
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


class Kinematics:
    """Paddle path, feet and head of N worlds, from the state path of a :class:`~pace.sim.engine.base.RobotEngine`.

    Attributes (float32, world frame; the same tensors for ever, overwritten by :meth:`update`):
        paddle_path: (N, S + 1, 12): centre (m), unit normal (the link's x axis), linear velocity of the centre (m/s),
            angular velocity (rad/s) at the S + 1 instants of the control step.
        foot_position, foot_velocity, foot_up: (N, 2, 3): centre of the left and right sole (m), its velocity (m/s),
            the foot's z axis, at the end of the control step.
        head_position: (N, 3) m, at the end of the control step.
    """

    def __init__(self, model: mujoco.MjModel, num_worlds: int, substeps: int, device: torch.device | str) -> None:
        self._device = torch.device(device)
        self._chains = _build_chains(model, wp.device_from_torch(self._device))
        self._num_worlds = num_worlds
        self.paddle_path = torch.zeros(num_worlds, substeps + 1, 12, device=device)
        self.foot_position = torch.zeros(num_worlds, 2, 3, device=device)
        self.foot_velocity = torch.zeros(num_worlds, 2, 3, device=device)
        self.foot_up = torch.zeros(num_worlds, 2, 3, device=device)
        self.head_position = torch.zeros(num_worlds, 3, device=device)
        outputs = (self.paddle_path, self.foot_position, self.foot_velocity, self.foot_up, self.head_position)
        self._outputs = [wp.from_torch(t) for t in outputs]
        self._mask = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self._path: tuple[Tensor, Tensor] | None = None
        self._push: tuple[Tensor | None, ...] = (None, None, None)

    def update(self, qpos_path: Tensor, qvel_path: Tensor, mask: Tensor | None = None) -> None:
        """Fill the attributes from qpos (N, S + 1, 28) and qvel (N, S + 1, 27).

        ``mask`` (N,) bool: the worlds in which they are new; ``None``: all. The path is remembered:
        :meth:`paddle_generalized_force` uses its end.
        """
        if self._path is None or self._path[0] is not qpos_path or self._path[1] is not qvel_path:
            self._bind(qpos_path, qvel_path)
        if mask is None:
            self._update()
        else:
            self._mask.copy_(mask)
            self._update_masked()

    def _bind(self, qpos_path: Tensor, qvel_path: Tensor) -> None:
        worlds, instants, _ = self.paddle_path.shape
        for name, path, width in (("qpos_path", qpos_path, 28), ("qvel_path", qvel_path, 27)):
            if path.shape != (worlds, instants, width):
                raise ValueError(f"{name} must be {(worlds, instants, width)}, not {tuple(path.shape)}")
        self._path = (qpos_path, qvel_path)
        self._warp_path = [wp.from_torch(qpos_path), wp.from_torch(qvel_path)]
        self._push = (None, None, None)  # its launch holds the old path
        inputs = [self._chains, *self._warp_path, *self._outputs]
        mask, items = wp.from_torch(self._mask), (worlds, instants + len(TIPS) - 1)
        self._update = record(_update, items, [mask, 0, *inputs], self._device)
        self._update_masked = record(_update, items, [mask, 1, *inputs], self._device)

    def paddle_generalized_force(self, force: Tensor, point: Tensor, out: Tensor) -> None:
        """Write J^T f of a force on the paddle's link into ``out`` (N, 27), for the end of the path last given.

        Args: force (N, 3) N and its point of attack (N, 3) m, world frame. Give the same tensors each time: others are
        bound anew, which takes longer.
        Errors: RuntimeError before the first :meth:`update`.
        """
        push = (force, point, out)
        if any(given is not bound for given, bound in zip(push, self._push, strict=True)):
            self._bind_push(push)
        self._compute_push()

    def _bind_push(self, push: tuple[Tensor, Tensor, Tensor]) -> None:
        if self._path is None:
            raise RuntimeError("paddle_generalized_force needs the robot's state: call update() first")
        self._push = push
        self._warp_push = [wp.from_torch(t) for t in push]
        inputs = [self._chains, *self._warp_path, *self._warp_push]
        self._compute_push = record(_paddle_jacobian_transpose, self._num_worlds, inputs, self._device)
