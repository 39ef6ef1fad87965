"""Names of a robot's parts, read from its MJCF and the configuration.

Another robot is another MJCF and another ``configs/robot/<name>.yaml``; nothing else in the package names a joint.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from pace.config.base import ConfigError
from pace.config.sim import RobotConfig

ASSETS = Path(__file__).parent / "assets"
#: Suffix of the sensors that count the contacts of a geom.
TOUCH = "_touch"
FEET = 2  # left and right
#: Names of the sensors that :func:`pace.sim.robot.build_model` appends: force of the table (N, world frame) on the
#: whole robot, and on its free hand if it has one.
TABLE_FORCES = ("table_force", "free_hand_force")
#: Groups of joints that reward terms sum over (``pace.task.state_kernels``); a robot may lack some.
GROUPS = ("ankles", "hip_waist_left_arm", "left_shoulder_roll", "right_arm")
PADDLE = "paddle"  # geom of the blade, a cylinder


@dataclass(frozen=True)
class RobotSpec:
    """Names of a robot's parts, in the order of the simulation's arrays.

    Attributes:
        joints: the J actuated joints, in the order of actions, of ``qpos[7:]`` and of ``qvel[6:]``.
        arm: those of the joints between trunk and paddle, past the waist.
        contacts: geoms other than the feet whose contacts are counted, in the order of ``body_contact``.
        paddle: site at the centre of the blade; the x axis of its link is the normal of the face.
        feet: sites at the centres of the left and the right sole.
        head: site at the middle of the head.
        groups: joints by the name of the group that reward terms sum over.
    """

    joints: tuple[str, ...]
    arm: tuple[str, ...]
    contacts: tuple[str, ...]
    paddle: str
    feet: tuple[str, ...]
    head: str
    groups: dict[str, tuple[str, ...]]

    @property
    def tips(self) -> tuple[str, ...]:
        """Sites whose motion is computed: paddle, left and right foot, head."""
        return (self.paddle, *self.feet, self.head)

    @classmethod
    def of(cls, robot: RobotConfig) -> RobotSpec:
        """The robot that the configuration names.

        Errors: :class:`ConfigError` for an MJCF that cannot be read, or that lacks a part or a free base.
        """
        found = _parts(model_path(robot))
        _check(robot, found)
        return cls(
            joints=found.joints,
            arm=_matching(found.joints, robot.arm),
            contacts=found.contacts,
            paddle=robot.paddle_site,
            feet=tuple(robot.foot_sites),
            head=robot.head_site,
            groups={name: _matching(found.joints, parts) for name, parts in robot.groups.items()},
        )


def joints_of(model: mujoco.MjModel, group: str) -> list[int]:
    """The joints of a group of ``robot.groups``, by their places in actions and targets; none if it has no such group.

    The model of :func:`pace.sim.robot.build_model` keeps each group as a tuple of its joints.
    """
    place = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TUPLE, group)
    if place < 0:
        return []
    first, size = model.tuple_adr[place], model.tuple_size[place]
    joints = model.tuple_objid[first : first + size]
    return [int(index) for index in np.flatnonzero(np.isin(model.actuator_trnid[:, 0], joints))]


@dataclass(frozen=True)
class Parts:
    """Names in an MJCF: actuated joints, sites, and geoms whose contacts are counted."""

    joints: tuple[str, ...]
    sites: tuple[str, ...]
    contacts: tuple[str, ...]


def model_path(robot: RobotConfig) -> Path:
    """The robot's MJCF: ``robot.model``, a file of this package's assets or any other path.

    Errors: :class:`ConfigError` for a missing file.
    """
    for path in (ASSETS / robot.model, Path(robot.model)):
        if path.is_file():
            return path
    raise ConfigError(f"robot.model: no file {robot.model} in {ASSETS} or in the working folder")


def read_scene(path: Path) -> mujoco.MjSpec:
    """Floor, table, net and ball with the robot of the MJCF ``path``, not yet compiled.

    Errors: :class:`ConfigError` for a file that MuJoCo cannot read.
    """
    scene = (ASSETS / "scene.xml").read_text(encoding="utf-8")
    try:
        spec = mujoco.MjSpec.from_string(scene, include={"robot.xml": path.read_bytes()})
    except (OSError, ValueError) as error:
        raise ConfigError(f"robot.model {path}: {str(error).splitlines()[0]}") from error
    spec.modelfiledir = str(path.parent)  # where its meshes are, if it has any
    return spec


@lru_cache
def _parts(path: Path) -> Parts:
    spec = read_scene(path)
    sensors = [sensor.name for sensor in spec.sensors]
    contacts = tuple(name.removesuffix(TOUCH) for name in sensors if name.endswith(TOUCH))
    free = [joint.name for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    joints = tuple(joint.name for joint in spec.joints if joint.name not in free)
    if len(free) != 1 or spec.joints[0].name != free[0]:
        raise ConfigError(f"robot.model {path}: the base must have the first and only free joint, found {free}")
    moved = tuple(actuator.target for actuator in spec.actuators)
    if moved != joints:
        raise ConfigError(f"robot.model {path}: every joint needs one actuator, in the order of the joints")
    if spec.geom(PADDLE) is None:
        raise ConfigError(f"robot.model {path}: the blade must be a geom named {PADDLE}")
    if any(name.endswith(TOUCH) for name in sensors[:FEET]) or len(contacts) + FEET != len(sensors):
        raise ConfigError(f"robot.model {path}: its sensors must be the force on each foot, then NAME{TOUCH} of geoms")
    return Parts(joints, tuple(site.name for site in spec.sites), contacts)


def _check(robot: RobotConfig, found: Parts) -> None:
    sites = {"paddle_site": [robot.paddle_site], "head_site": [robot.head_site], "foot_sites": robot.foot_sites}
    for key, names in sites.items():
        missing = [name for name in names if name not in found.sites]
        if missing:
            raise ConfigError(f"robot.{key}: {robot.model} has no site {', '.join(missing)}")
    unsummed = sorted(set(robot.groups) - set(GROUPS))
    if unsummed:
        raise ConfigError(f"robot.groups: no reward term sums over {', '.join(unsummed)}; known: {', '.join(GROUPS)}")
    strange = sorted(set(robot.reset_limits) - set(found.joints))
    if strange:
        raise ConfigError(f"robot.reset_limits: {robot.model} has no joint {', '.join(strange)}")
    for key, parts in {"arm": robot.arm, **{f"groups.{name}": parts for name, parts in robot.groups.items()}}.items():
        unknown = [part for part in parts if not _matching(found.joints, [part])]
        if unknown:
            raise ConfigError(f"robot.{key}: no joint of {robot.model} has {', '.join(unknown)} in its name")


def _matching(joints: Iterable[str], parts: Iterable[str]) -> tuple[str, ...]:
    """The joints whose name contains one of ``parts``."""
    wanted = tuple(parts)
    return tuple(name for name in joints if any(part in name for part in wanted))
