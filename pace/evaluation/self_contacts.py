"""Parts of a robot that are inside of one another, by MuJoCo's distance of their geoms.

Sought in poses, not in the engine's contacts: a robot's model need not list the pairs that would collide.
"""

from __future__ import annotations

from itertools import combinations

import mujoco
import numpy as np
from numpy.typing import NDArray

from pace.sim.robot_spec import RobotSpec

Pair = tuple[int, int]


def part(model: mujoco.MjModel, spec: RobotSpec, geom: int) -> str:
    """What a geom is called: its name if it is of ``spec.contacts``, else its body's (the spheres of a foot)."""
    name = model.geom(geom).name
    return name if name in spec.contacts else model.body(model.geom_bodyid[geom]).name


def pairs_of(model: mujoco.MjModel, spec: RobotSpec) -> dict[Pair, str]:
    """Pairs of the robot's geoms that can meet, with the names of their parts.

    Not those on one link or on links that one joint connects, nor those that meet in the nominal pose.
    """
    base = model.jnt_bodyid[0]
    links = model.body_weldid
    geoms = [geom for geom in range(model.ngeom) if model.body_rootid[model.geom_bodyid[geom]] == base]
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[0]
    mujoco.mj_kinematics(model, data)
    found = {}
    for one, other in combinations(geoms, 2):
        first, second = links[model.geom_bodyid[one]], links[model.geom_bodyid[other]]
        joined = first == second or second == _before(model, first) or first == _before(model, second)
        if not joined and not depth(model, data, (one, other)):
            found[one, other] = " - ".join(sorted(part(model, spec, geom) for geom in (one, other)))
    return found


def _before(model: mujoco.MjModel, link: int) -> int:
    """The link that carries ``link``."""
    return model.body_weldid[model.body_parentid[link]]


def depth(model: mujoco.MjModel, data: mujoco.MjData, pair: Pair) -> float:
    """m, by which two geoms overlap; 0 if they do not."""
    return max(0.0, -mujoco.mj_geomDistance(model, data, *pair, 0.0, None))


def depths(model: mujoco.MjModel, spec: RobotSpec, poses: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Depth (P,) m of each pair of parts that meets in any of ``poses`` (P, J), joint positions in rad."""
    data, pairs = mujoco.MjData(model), pairs_of(model, spec)
    data.qpos[:] = model.key_qpos[0]
    found: dict[str, NDArray[np.float64]] = {}
    for number, pose in enumerate(poses):
        data.qpos[7:] = pose
        mujoco.mj_kinematics(model, data)
        for pair, name in pairs.items():
            deep = depth(model, data, pair)
            if deep > 0.0:
                row = found.setdefault(name, np.zeros(len(poses)))
                row[number] = max(row[number], deep)
    return found
