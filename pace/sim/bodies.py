"""The robot's body for the ball: which of its collision geoms the ball may meet next, and where they are meanwhile.

The shapes come from the compiled model: every geom of the robot but the paddle and those for the eye. A geom that is no
sphere, capsule, box or cylinder counts as its bounding box. Poses are computed only round a near ball, in the order of
the tree: a limb out of whose reach the ball stays is left out with all that it carries.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
import torch
import warp as wp
from torch import Tensor

from pace.arrays.launch import Launch
from pace.sim.ball.aero import GRAVITY
from pace.sim.ball.ball import BallSim
from pace.sim.ball.robot_body import RobotBody, turning_between
from pace.sim.ball.state import BallArrays
from pace.sim.body_shapes import Array, Shape, links_of, shapes_of
from pace.sim.robot_spec import PADDLE

#: Between two instants a link turns at a rate that is not quite constant: far less than this share faster.
_UNEVEN = wp.constant(1.01)


@wp.struct
class Tree:
    """L links in the order of the joints, each after the one that carries it; row 0 is the base."""

    parent: wp.array[wp.int32]
    end: wp.array[wp.int32]  # first row behind all that the link carries
    offset: wp.array[wp.vec3]  # m, joint's origin in the parent's frame
    orientation: wp.array[wp.quat]  # of the joint's frame in the parent's frame, at angle 0
    axis: wp.array[wp.vec3]
    extent: wp.array[wp.float32]  # m, no shape of the link, or of what it carries, is farther from its origin
    centre: wp.array[wp.vec3]  # m, of a sphere that holds the link's own shapes
    radius: wp.array[wp.float32]  # m, of that sphere
    first: wp.array[wp.int32]  # (L + 1,) the shapes of row i are first[i] to first[i + 1] - 1


@wp.func
def _place(tree: Tree, row: int, qpos: wp.array[float], instant: int, body: RobotBody, world: int) -> wp.vec3:
    """Store where a link's origin is at an instant."""
    origin = wp.vec3(qpos[0], qpos[1], qpos[2])
    if row > 0:
        parent = tree.parent[row]
        lever = wp.quat_rotate(body.link_rotation[world, instant, parent], tree.offset[row])
        origin = body.link_position[world, instant, parent] + lever
    body.link_position[world, instant, row] = origin
    return origin


@wp.func
def _turn(tree: Tree, row: int, qpos: wp.array[float], instant: int, body: RobotBody, world: int) -> wp.vec3:
    """Store how a link is turned at an instant; returns the centre of the sphere about its shapes."""
    rotation = wp.normalize(wp.quat(qpos[4], qpos[5], qpos[6], qpos[3]))  # MuJoCo writes w, x, y, z
    if row > 0:
        rotation = body.link_rotation[world, instant, tree.parent[row]] * tree.orientation[row]
        rotation = rotation * wp.quat_from_axis_angle(tree.axis[row], qpos[6 + row])
    body.link_rotation[world, instant, row] = rotation
    return body.link_position[world, instant, row] + wp.quat_rotate(rotation, tree.centre[row])


@wp.func
def _apart(point: wp.vec3, start: wp.vec3, end: wp.vec3, reach: float) -> bool:
    """Whether a sphere that moves from ``start`` to ``end`` stays farther than ``reach`` from a point."""
    nearest = wp.min(wp.length(point - start), wp.length(point - end))
    return nearest - 0.5 * wp.length(end - start) > reach


@wp.func
def _way(ball: BallArrays, radius: float, paddle: wp.array2d[float], size: float, duration: float, world: int) -> float:
    """No point of the ball gets farther (m) from where its centre is now, even if the paddle hits it."""
    speed = wp.length(ball.velocity[world]) + radius * wp.length(ball.spin[world]) + GRAVITY * duration
    strike = wp.float32(0.0)
    for end in range(2):
        knot = paddle[end * (paddle.shape[0] - 1)]
        turning = size * wp.length(wp.vec3(knot[9], knot[10], knot[11]))
        strike = wp.max(strike, wp.length(wp.vec3(knot[6], knot[7], knot[8])) + turning)
    away = wp.length(ball.position[world] - wp.vec3(paddle[0, 0], paddle[0, 1], paddle[0, 2])) - size - radius
    if away < (speed + strike) * duration:
        speed += 2.0 * strike
    return radius + speed * duration


@wp.func
def _fastest(tree: Tree, body: RobotBody, world: int, row: int, path_dt: float) -> float:
    """No point of the link's own shapes moves faster (m/s)."""
    fastest = wp.float32(0.0)
    for knot in range(body.link_position.shape[1] - 1):
        q0 = body.link_rotation[world, knot, row]
        q1 = body.link_rotation[world, knot + 1, row]
        p0 = body.link_position[world, knot, row] + wp.quat_rotate(q0, tree.centre[row])
        p1 = body.link_position[world, knot + 1, row] + wp.quat_rotate(q1, tree.centre[row])
        turning = wp.length(turning_between(q0, q1, path_dt)) * tree.radius[row]
        fastest = wp.max(fastest, wp.length(p1 - p0) / path_dt + turning)
    return _UNEVEN * fastest


@wp.func
def _find_near(
    tree: Tree,
    qpos_path: wp.array3d[float],
    point: wp.vec3,
    way: float,
    wanted: wp.array2d[wp.bool],
    body: RobotBody,
    world: int,
) -> int:
    """List the shapes that a ball at ``point`` may meet on its ``way`` (m), and pose their links at both ends of the
    control step. Returns how many they are; ``wanted`` are the links that were posed."""
    last = qpos_path.shape[1] - 1
    count = wp.int32(0)
    row = wp.int32(0)
    while row < tree.parent.shape[0]:
        start = _place(tree, row, qpos_path[world, 0], 0, body, world)
        end = _place(tree, row, qpos_path[world, last], last, body, world)
        wanted[world, row] = not _apart(point, start, end, way + tree.extent[row])
        if wanted[world, row]:
            start = _turn(tree, row, qpos_path[world, 0], 0, body, world)
            end = _turn(tree, row, qpos_path[world, last], last, body, world)
            if not _apart(point, start, end, way + tree.radius[row]):
                for shape in range(tree.first[row], tree.first[row + 1]):
                    body.near[world, count] = shape
                    count += 1
            row += 1
        else:
            row = tree.end[row]
    return count


@wp.kernel
def _pose(
    tree: Tree,
    qpos_path: wp.array3d[float],
    paddle_path: wp.array3d[float],
    paddle_size: float,
    ball: BallArrays,
    radius: wp.array[float],
    path_dt: float,
    wanted: wp.array2d[wp.bool],
    body: RobotBody,
):
    """Find the shapes that a world's ball may meet in the coming flight; pose their links and bound their speed."""
    world = wp.tid()
    last = qpos_path.shape[1] - 1
    way = _way(ball, radius[world], paddle_path[world], paddle_size, path_dt * float(last), world)
    count = _find_near(tree, qpos_path, ball.position[world], way, wanted, body, world)
    body.near_count[world] = count
    if count == 0:
        return
    speed = wp.float32(0.0)
    row = wp.int32(0)
    while row < tree.parent.shape[0]:
        if wanted[world, row]:
            for instant in range(1, last):
                _origin = _place(tree, row, qpos_path[world, instant], instant, body, world)
                _centre = _turn(tree, row, qpos_path[world, instant], instant, body, world)
            if tree.radius[row] > 0.0:
                speed = wp.max(speed, _fastest(tree, body, world, row, path_dt))
            row += 1
        else:
            row = tree.end[row]
    body.speed[world] = speed


def _spheres(count: int, shapes: Sequence[Shape]) -> Iterator[tuple[Array, float]]:
    """A sphere about the shapes of each link; of radius 0 about its origin if it has none."""
    for row in range(count):
        own = [shape for shape in shapes if shape.row == row]
        centre = np.mean([shape.centre for shape in own], axis=0) if own else np.zeros(3)
        yield centre, max((float(np.linalg.norm(s.centre - centre)) + s.reach for s in own), default=0.0)


def _build(model: mujoco.MjModel, shapes: Sequence[Shape], device: wp.Device) -> Tree:
    links = links_of(model)
    spheres = list(_spheres(len(links), shapes))
    extent = [float(np.linalg.norm(centre)) + radius for centre, radius in spheres]
    end = list(range(1, len(links) + 1))
    for row in range(len(links) - 1, 0, -1):
        parent = links[row].parent
        extent[parent] = max(extent[parent], float(np.linalg.norm(links[row].offset)) + extent[row])
        end[parent] = max(end[parent], end[row])
    tree = Tree()
    for name, values in {
        "parent": [link.parent for link in links],
        "end": end,
        "first": np.searchsorted([shape.row for shape in shapes], range(len(links) + 1)),
    }.items():
        setattr(tree, name, wp.array(values, dtype=wp.int32, device=device))
    for name, vectors in {
        "offset": [link.offset for link in links],
        "axis": [link.axis for link in links],
        "centre": [centre for centre, _ in spheres],
    }.items():
        setattr(tree, name, wp.array(vectors, dtype=wp.vec3, device=device))
    tree.orientation = _quats([link.quat for link in links], device)
    tree.extent = wp.array(extent, dtype=wp.float32, device=device)
    tree.radius = wp.array([radius for _, radius in spheres], dtype=wp.float32, device=device)
    return tree


def _quats(quats: Sequence[Array], device: wp.Device) -> wp.array:
    return wp.array([np.roll(quat, -1) for quat in quats], dtype=wp.quat, device=device)  # Warp writes x, y, z, w


class Bodies:
    """Bodies of N robots as surfaces for the ball.

    Attributes: ``surface`` what :class:`pace.sim.ball.BallSim` flies among; ``shapes`` its G shapes.

    Args:
        model: the robot's model.
        paddle_hand: names of bodies or geoms of the hand that holds the paddle.
        num_worlds: N.
        substeps: S, physics steps of a control step.
        control_dt: s.
        device: of all tensors.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        paddle_hand: Sequence[str],
        num_worlds: int,
        substeps: int,
        control_dt: float,
        device: torch.device,
    ) -> None:
        self.shapes = shapes_of(model, paddle_hand)
        self._device, self._num_worlds, self._path_dt = device, num_worlds, control_dt / substeps
        self._paddle_size = float(np.linalg.norm(model.geom(PADDLE).size[:2]))
        where = wp.device_from_torch(device)
        self._tree = _build(model, self.shapes, where)
        links = self._tree.parent.shape[0]
        self._wanted = torch.zeros(num_worlds, links, dtype=torch.bool, device=device)
        self.surface = _surface(self.shapes, (num_worlds, substeps + 1, links), where)

    def poser(self, qpos_path: Tensor, paddle_path: Tensor, ball: BallSim) -> Launch:
        """What to call before each flight of ``ball``, once these tensors hold the paths of the control step."""
        given = {"qpos_path": qpos_path, "paddle_path": paddle_path, "paddle_size": self._paddle_size}
        given |= {"ball": ball, "radius": ball.params.radius, "path_dt": self._path_dt}
        own = {"tree": self._tree, "wanted": self._wanted, "body": self.surface}
        return Launch(_pose, self._num_worlds, self._device, **given, **own)


def _surface(shapes: Sequence[Shape], poses: tuple[int, int, int], device: wp.Device) -> RobotBody:
    surface = RobotBody()
    surface.link = wp.array([shape.row for shape in shapes], dtype=wp.int32, device=device)
    surface.centre = wp.array([shape.centre for shape in shapes], dtype=wp.vec3, device=device)
    surface.rotation = _quats([shape.quat for shape in shapes], device)
    surface.half = wp.array([shape.half for shape in shapes], dtype=wp.vec3, device=device)
    surface.rounding = wp.array([shape.rounding for shape in shapes], dtype=wp.float32, device=device)
    surface.reach = wp.array([shape.reach for shape in shapes], dtype=wp.float32, device=device)
    surface.hand = wp.array([shape.hand for shape in shapes], dtype=wp.bool, device=device)
    surface.link_position = wp.zeros(poses, dtype=wp.vec3, device=device)
    surface.link_rotation = wp.zeros(poses, dtype=wp.quat, device=device)
    surface.near = wp.zeros((poses[0], len(shapes)), dtype=wp.int32, device=device)
    surface.near_count = wp.zeros(poses[0], dtype=wp.int32, device=device)
    surface.speed = wp.zeros(poses[0], dtype=wp.float32, device=device)
    return surface
