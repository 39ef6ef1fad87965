"""The true state of N worlds, for rewards and the critic, and quantities that several of them share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pace.arrays.launch import Launch
from pace.arrays.state import Stateful, tensors_named
from pace.arrays.tensors import allocate
from pace.task.game import Game
from pace.task.measures import Derived, Measures
from pace.task.state_kernels import JointArrays, derive, measure

if TYPE_CHECKING:
    from pace.sim.ball.ball import BallSim
    from pace.sim.robot_state import RobotState
    from pace.sim.worlds import Worlds


#: Groups of joints that reward terms sum over: keys of ``robot.groups``; a robot may lack some.
JOINT_GROUPS = tuple(name for name in JointArrays.vars if name != "nominal")  # type: ignore[attr-defined]


class TaskState(Derived, Stateful):
    """True state of the task after a control step. Privileged: the actor never reads it.

    Attributes, besides those of :class:`Derived`: ``robot``, ``ball`` (simulation), ``game`` (rules and forecast),
    ``action`` and ``previous_action`` (N, J); ``mocap_delay`` (N,) control steps, delay of the motion capture;
    ``nominal`` (J,) rad, ``joint_range`` the middle of the joints' ranges and half of their widths, (J,)
    rad each; ``something_to_hit``, ``lost`` (N,) bool. After :meth:`refresh`: ``measures``, those of
    :class:`Measures` by name.
    """

    STATE = (
        "action",
        "previous_action",
        "nominal",
        "mocap_delay",
        "lost",
        "something_to_hit",
        "base_error",
        "shift",
        "apex",
        "target",
        "arrival",
        "foot_load",
        "foot_contact",
        "feet_distance",
    )

    def __init__(self, worlds: Worlds, game: Game, mocap_delay: Tensor) -> None:
        count, joints, device = worlds.num_worlds, worlds.nominal.shape[0], worlds.device
        super().__init__(**vars(allocate(Derived, count, device, joints=joints, feet=2)))
        self.robot: RobotState = worlds.robot
        self.ball: BallSim = worlds.ball
        self.game, self.mocap_delay = game, mocap_delay
        self.nominal, lower, upper = worlds.nominal, worlds.joint_lower, worlds.joint_upper
        self.joint_range = 0.5 * (upper + lower), 0.5 * (upper - lower)
        self.action = torch.zeros(count, joints, device=device)
        self.previous_action = torch.zeros(count, joints, device=device)
        self.lost, self.something_to_hit = game.ends.lost, game.target.something_to_hit
        self.measures: dict[str, Tensor] = vars(allocate(Measures, count, device))
        self._record(worlds)

    def _record(self, worlds: Worlds) -> None:
        ball, game, count, device = self.ball, self.game, worlds.num_worlds, worlds.device
        seen = {"game": game, "ball": ball, "robot": self.robot, "nominal": self.nominal, "rules": game.rules}
        self._derive = Launch(derive, count, device, derived=self, **seen)
        joints, members = worlds.spec.joints, worlds.spec.groups
        groups = {
            group: torch.tensor([float(name in members.get(group, ())) for name in joints], device=device)
            for group in JOINT_GROUPS
        }
        measured = tensors_named(self, ("action", "previous_action", "foot_contact", "base_error"))
        measured |= {"robot": self.robot, "point": game.target.point, "joints": groups | {"nominal": self.nominal}}
        self._measure = Launch(measure, count, device, measures=self.measures, **measured)

    def refresh(self) -> None:
        """Compute all shared quantities from the robot's and the ball's new state."""
        self._derive()
        self._measure()

    def derive(self) -> None:
        """Recompute those that change with a new serve."""
        self._derive()
