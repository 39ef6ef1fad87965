"""What rewards and the critic read: the true state of N worlds, and quantities that several of them share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import warp as wp
from torch import Tensor

from pace.arrays.share import record, share, share_all
from pace.task.game import Game
from pace.task.state_kernels import DerivedArrays, JointArrays, Measures, RobotArrays, derive, measure

if TYPE_CHECKING:
    from pace.sim.ball.ball import BallSim
    from pace.sim.worlds import RobotState, Worlds


#: Groups of joints that reward terms sum over: keys of ``robot.groups``; a robot may lack some.
JOINT_GROUPS = tuple(name for name in JointArrays.vars if name != "nominal")  # type: ignore[attr-defined]


class TaskState:
    """True state of the task after a control step. Privileged: the actor never reads it.

    Attributes: ``robot``, ``ball`` (simulation), ``game`` (rules and forecast), ``action`` and ``previous_action``
    (N, J); ``mocap_delay`` (N,) control steps by which motion capture is late; ``nominal`` (J,) rad, ``joint_range``
    the middle of the joints' ranges and the way from there to their ends, (J,) rad each.
    After :meth:`refresh`: ``measures`` name -> (N,) as its kernel computes them: ``joint_power`` and ``ankle_power`` W,
    norms over the joints of torque times velocity; ``joint_acceleration`` (rad/s^2)^2 and ``action_change``, sums of
    squares; the sum of |joint - nominal| over each other group of :data:`JOINT_GROUPS`, rad; ``foot_tilt``, squared
    horizontal part of the soles' normals, ``foot_slide`` m/s, horizontal speed of the feet in contact, both summed;
    ``foot_steepness``, the largest horizontal over vertical force of a foot in contact; ``feet_down``, number of feet
    in contact; ``contacts``, of other bodies; ``paddle_to_head``, ``paddle_to_target``, ``base_to_target`` m; squares
    of the base's motion: ``vertical_velocity`` (m/s)^2, ``roll_pitch_rate``, ``yaw_rate`` (rad/s)^2; ``base_tilt``,
    squared horizontal part of gravity in the body frame.
    Also what :meth:`derive` computes:
    ``something_to_hit`` (N,) bool; ``apex``, ``target`` (N, 3) m, the point to stand by where there is nothing to hit;
    ``arrival`` (N,) s until the ball is at the target, 0 where there is nothing to hit; ``base_error``, ``shift``
    (N, 2) m from the base to where it should stand, for the rewards and as the networks see it; ``foot_load``
    (N, 2) N, ``foot_contact`` (N, 2) bool, ``feet_distance`` (N,) m; ``paddle_to_target`` (N, 3) m; ``joint_offset``
    (N, J) rad from the nominal pose; ``serve_progress`` (N,), share of the longest serve, and ``episode_progress``
    (N,), share of the episode's serves, 0 where episodes do not end.
    """

    def __init__(self, worlds: Worlds, game: Game, mocap_delay: Tensor) -> None:
        self.robot: RobotState = worlds.robot
        self.ball: BallSim = worlds.ball
        self.game = game
        self.nominal, lower, upper = worlds.nominal, worlds.joint_lower, worlds.joint_upper
        self.joint_range = 0.5 * (upper + lower), 0.5 * (upper - lower)
        count, joints, device = worlds.num_worlds, worlds.nominal.shape[0], worlds.device
        self.action = torch.zeros(count, joints, device=device)
        self.previous_action = torch.zeros(count, joints, device=device)
        self.lost, self.something_to_hit = game.ends.lost, game.target.something_to_hit
        self.measures = {name: torch.zeros(count, device=device) for name in Measures.vars}  # type: ignore[attr-defined]
        self._allocate(count, device)
        self._record(worlds)
        self.mocap_delay = mocap_delay

    def _allocate(self, count: int, device: torch.device) -> None:
        self.base_error, self.shift = torch.zeros(count, 2, device=device), torch.zeros(count, 2, device=device)
        self.apex, self.target = torch.zeros(count, 3, device=device), torch.zeros(count, 3, device=device)
        self.arrival = torch.zeros(count, device=device)
        self.foot_load = torch.zeros(count, 2, device=device)
        self.foot_contact = torch.zeros(count, 2, dtype=torch.bool, device=device)
        self.feet_distance = torch.zeros(count, device=device)
        shown = torch.zeros(count, 5 + self.action.shape[1], device=device)  # to the critic; not part of the state
        self.paddle_to_target, self.joint_offset = shown[:, :3], shown[:, 5:]
        self.serve_progress, self.episode_progress = shown[:, 3], shown[:, 4]

    def _record(self, worlds: Worlds) -> None:
        ball, robot = self.ball, self.robot
        seen = (ball.position, ball.velocity, robot.base_position, robot.paddle_position)
        seen += (robot.joint_position, self.nominal, robot.foot_force, robot.foot_position)
        derived = share_all(DerivedArrays, vars(self))
        inputs = [self.game.arrays(), derived, *(share(tensor) for tensor in seen), self.game.rules]
        self._derive = record(derive, worlds.num_worlds, inputs, worlds.device)
        joints, groups = worlds.spec.joints, worlds.spec.groups
        self._joints = {"nominal": self.nominal} | {
            group: torch.tensor([float(name in groups.get(group, ())) for name in joints], device=worlds.device)
            for group in JOINT_GROUPS
        }
        actions = {"action": self.action, "previous_action": self.previous_action}
        measured = share_all(RobotArrays, vars(robot) | actions)
        arrays = [share_all(JointArrays, self._joints), share(self.foot_contact), share(self.game.target.point)]
        arrays += [wp.from_torch(self.base_error, dtype=wp.vec2), share_all(Measures, self.measures)]
        self._measure = record(measure, worlds.num_worlds, [measured, *arrays], worlds.device)

    def refresh(self) -> None:
        """Compute all shared quantities from the robot's and the ball's new state."""
        self._derive()
        self._measure()

    def derive(self) -> None:
        """Compute those again that change with a new serve."""
        self._derive()
