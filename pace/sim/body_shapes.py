"""The robot's collision geoms by the links that carry them, and its tree of links, read from the compiled model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pace.config.base import ConfigError
from pace.sim.robot import VISUAL_GROUP
from pace.sim.robot_spec import PADDLE

#: ``rounding`` of a cylinder.
CYLINDER = -1.0

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # m, and quaternion w, x, y, z


@dataclass(frozen=True)
class Shape:
    """A geom of the robot in the frame of its link; see :class:`pace.sim.ball.robot_body.RobotBody`."""

    row: int
    centre: Array
    quat: Array
    half: tuple[float, float, float]
    rounding: float
    hand: bool

    @property
    def reach(self) -> float:
        """m, radius of a sphere about the centre that holds it."""
        if self.rounding == CYLINDER:
            return float(np.hypot(self.half[0], self.half[2]))
        return float(np.linalg.norm(self.half)) + self.rounding


def _compose(outer: Pose, inner: Pose) -> Pose:
    place, quat = np.zeros(3), np.zeros(4)
    mujoco.mju_mulPose(place, quat, *outer, *inner)
    return place, quat


def _carrier(model: mujoco.MjModel, body: int) -> tuple[int, Pose]:
    """The body with a joint that carries ``body`` (or is it), and the pose of ``body`` in its frame."""
    pose: Pose = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    while not model.body_jntnum[body]:
        pose = _compose((model.body_pos[body], model.body_quat[body]), pose)
        body = int(model.body_parentid[body])
    return body, pose


def shapes_of(model: mujoco.MjModel, paddle_hand: Sequence[str]) -> list[Shape]:
    """The robot's collision geoms but the paddle, by their links.

    Args: paddle_hand: names of bodies or geoms of the hand that holds the paddle.
    Errors: :class:`ConfigError` for a name that the robot does not have.
    """
    bodies, geoms = (_named(model, kind, paddle_hand) for kind in (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_GEOM))
    unknown = [name for name, *found in zip(paddle_hand, bodies, geoms, strict=True) if max(found) < 0]
    if unknown:
        raise ConfigError(f"robot.paddle_hand: the robot has no body or geom {', '.join(unknown)}")
    root, shapes = int(model.jnt_bodyid[0]), []
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        ours = model.body_rootid[body] == root and model.geom_group[geom] != VISUAL_GROUP
        if ours and model.geom(geom).name != PADDLE:
            shapes.append(_shape(model, geom, body in bodies or geom in geoms))
    return sorted(shapes, key=lambda shape: shape.row)


def _named(model: mujoco.MjModel, kind: mujoco.mjtObj, names: Sequence[str]) -> list[int]:
    """Ids of ``names``; -1 for none."""
    return [mujoco.mj_name2id(model, kind, name) for name in names]


def _shape(model: mujoco.MjModel, geom: int, hand: bool) -> Shape:
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), [float(length) for length in model.geom_size[geom]]
    where: Pose = model.geom_pos[geom], model.geom_quat[geom]
    half, rounding = (size[0], size[1], size[2]), 0.0
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        half, rounding = (0.0, 0.0, 0.0), size[0]
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        half, rounding = (0.0, 0.0, size[1]), size[0]
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        half, rounding = (size[0], size[0], size[1]), CYLINDER
    elif kind != mujoco.mjtGeom.mjGEOM_BOX:
        middle, (x, y, z) = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:].tolist()
        where, half = _compose(where, (middle, np.array([1.0, 0.0, 0.0, 0.0]))), (x, y, z)
    carrier, pose = _carrier(model, int(model.geom_bodyid[geom]))
    centre, quat = _compose(pose, where)
    return Shape(int(model.body_jntadr[carrier]), centre, quat, half, rounding, hand)


@dataclass(frozen=True)
class Link:
    """A link and its joint, in the frame of the link that carries it; row 0 is the base."""

    parent: int
    offset: Array
    quat: Array
    axis: Array


def links_of(model: mujoco.MjModel) -> list[Link]:
    """The base, then a link for each joint, in MuJoCo's order: what a link carries follows it at once."""
    links = [Link(-1, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))]
    for joint in range(1, model.njnt):
        body = int(model.jnt_bodyid[joint])
        carrier, pose = _carrier(model, int(model.body_parentid[body]))
        offset, quat = _compose(pose, (model.body_pos[body], model.body_quat[body]))
        links.append(Link(int(model.body_jntadr[carrier]), offset, quat, model.jnt_axis[joint]))
    return links
