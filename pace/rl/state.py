"""What rewards and the critic read: the true state of N worlds, and quantities that several of them share."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch

from pace.config import RewardConfig
from pace.rl.task import Game, nothing_to_hit

if TYPE_CHECKING:
    from pace.sim.ball import BallSim
    from pace.sim.worlds import RobotState, Worlds

#: A foot that pushes with less touches nothing, N.
CONTACT_FORCE = 1.0


def _is_right_arm(name: str) -> bool:
    return name.startswith("Right_") and ("Shoulder" in name or "Elbow" in name)


def _is_hip_waist_left_arm(name: str) -> bool:
    left_arm = name.startswith("Left_") and ("Shoulder_Pitch" in name or "Elbow" in name)
    return left_arm or "Hip_Yaw" in name or "Hip_Roll" in name or name == "Waist"


#: Groups of joints that reward terms sum over.
JOINT_GROUPS: dict[str, Callable[[str], bool]] = {
    "ankles": lambda name: "Ankle" in name,
    "hip_waist_left_arm": _is_hip_waist_left_arm,
    "left_shoulder_roll": lambda name: name == "Left_Shoulder_Roll",
    "right_arm": _is_right_arm,
}


class TaskState:
    """True state of the task after a control step. Privileged: the actor never reads it.

    Attributes: ``robot``, ``ball`` (simulation), ``game`` (rules and forecast), ``action`` and ``previous_action``
    (N, J); ``nominal``, ``joint_lower``, ``joint_upper`` (J,) rad; ``groups`` name -> (J,) of 0 and 1.
    After :meth:`refresh`: ``something_to_hit``, ``lost`` (N,) bool, ``base_error`` (N, 2) m from the base to its
    target, ``foot_load`` (N, 2) N, ``foot_contact`` (N, 2) bool, ``feet_distance`` (N,) m, ``joint_power`` (N, J) W,
    ``joint_deviation`` (N, J) rad.
    """

    def __init__(self, worlds: Worlds, game: Game, config: RewardConfig) -> None:
        self.robot: RobotState = worlds.robot
        self.ball: BallSim = worlds.ball
        self.game = game
        self._config = config
        self.nominal, self.joint_lower, self.joint_upper = worlds.nominal, worlds.joint_lower, worlds.joint_upper
        count, joints, device = worlds.num_worlds, worlds.nominal.shape[0], worlds.device
        self.action = torch.zeros(count, joints, device=device)
        self.previous_action = torch.zeros(count, joints, device=device)
        self.groups = {
            group: torch.tensor([float(belongs(name)) for name in worlds.joint_names], device=device)
            for group, belongs in JOINT_GROUPS.items()
        }
        self._arm_offset = torch.tensor(config.arm_offset, device=device)
        self._idle_base = torch.tensor(config.idle_base_xy, device=device)
        self.something_to_hit = torch.zeros(count, dtype=torch.bool, device=device)
        self.lost = torch.zeros(count, dtype=torch.bool, device=device)
        self.base_error = torch.zeros(count, 2, device=device)
        self.foot_load = torch.zeros(count, 2, device=device)
        self.foot_contact = torch.zeros(count, 2, dtype=torch.bool, device=device)
        self.feet_distance = torch.zeros(count, device=device)
        self.joint_power = torch.zeros(count, joints, device=device)
        self.joint_deviation = torch.zeros(count, joints, device=device)

    def refresh(self) -> None:
        """Compute the shared quantities from the robot's new state."""
        robot = self.robot
        torch.linalg.vector_norm(robot.foot_force, dim=-1, out=self.foot_load)
        torch.gt(self.foot_load, CONTACT_FORCE, out=self.foot_contact)
        apart = robot.foot_position[:, 0] - robot.foot_position[:, 1]
        torch.linalg.vector_norm(apart, dim=-1, out=self.feet_distance)
        torch.mul(robot.joint_torque, robot.joint_velocity, out=self.joint_power)
        torch.sub(robot.joint_position, self.nominal, out=self.joint_deviation).abs_()
        self.refresh_target()

    def refresh_target(self) -> None:
        """Compute whether there is something to hit, and where the base should be; again after a new serve."""
        closed = nothing_to_hit(self.ball.position, self.ball.velocity, self._config.nothing_to_hit)
        referee = self.game.referee
        torch.logical_and(referee.is_open & ~referee.touched, ~closed, out=self.something_to_hit)
        target = self.game.target.point[:, :2] + self._arm_offset
        goal = torch.where(self.something_to_hit.unsqueeze(-1), target, self._idle_base)
        torch.sub(goal, self.robot.base_position[:, :2], out=self.base_error)
