"""The deployed policy: ``step(readings, state) -> (targets, state)``, in one network.

Everything between the readings and the actor is :class:`pace.onboard.actor.Onboard`, which the environment runs too.
The memory between calls is one tensor: the output ``state_next`` is the next call's input ``state``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import torch
from torch import Tensor, nn

from pace.config.task import TaskConfig
from pace.onboard.actor import Onboard, Readings, Signals
from pace.onboard.ball_track import Track
from pace.onboard.estimate import Part, columns
from pace.onboard.estimates import ESTIMATES, observed
from pace.onboard.kinematics import PaddleChain
from pace.rl.policies import TaskPolicy
from pace.sim.robot import nominal_pose
from pace.sim.robot_spec import RobotSpec
from pace.task.observations import POLICY, check_policy, width


class Port(NamedTuple):
    """An input or output of the network: numbers, unit, meaning, the frame that it is given in, and its age: that of
    the call, or the input that says how old it is."""

    size: int
    unit: str
    meaning: str
    frame: str = "-"
    age: str = "current"


def joints_of(config: TaskConfig) -> int:
    """Number of the robot's joints."""
    return len(RobotSpec.of(config.robot).joints)


def readings(joints: int) -> dict[str, Port]:
    """Inputs (N, size) besides the state: the readings of one control step."""
    return {
        "base_angular_velocity": Port(3, "rad/s", "gyroscope of the trunk, body frame", "body"),
        "base_position": Port(3, "m", "trunk, world frame", "world", "base_age"),
        "projected_gravity": Port(3, "1", "direction of gravity in the body frame; upright: (0, 0, -1)", "body"),
        "heading": Port(
            2, "1", "x axis of the trunk on the ground, world frame; towards the opponent: (1, 0)", "world", "base_age"
        ),
        "joint_position": Port(joints, "rad", "in the order of joint_names, not relative to the nominal pose", "joint"),
        "joint_velocity": Port(joints, "rad/s", "in the order of joint_names", "joint"),
        "ball_position": Port(
            3, "m", "centre of the ball, world frame; without a new frame its last", "world", "ball_age"
        ),
        "base_age": Port(1, "s", "time since the frame with base position and heading was captured"),
        "base_new": Port(1, "0 or 1", "1: a frame with them arrived since the call before"),
        "ball_age": Port(1, "s", "time since the ball's frame was captured"),
        "ball_new": Port(1, "0 or 1", "1: a frame with the ball arrived since the call before"),
    }


def results(joints: int) -> dict[str, Port]:
    """Outputs (N, size) besides the state."""
    return {
        "joint_target": Port(joints, "rad", "targets of the joints' position control until the next call", "joint"),
        "action": Port(
            joints, "1", "the network's output: the same from nominal_pose on, in action_scale rad", "joint"
        ),
        "predicted_apex": Port(3, "m", "learned prediction, or the idle point while there is nothing to hit", "world"),
        "predicted_target": Port(3, "m", "point at which the paddle should meet the ball, likewise", "world"),
        "predicted_time": Port(1, "s", "until the ball is at the target; 0 while there is nothing to hit"),
        "something_to_hit": Port(1, "0 or 1", "the ball can still be hit, as far as the robot can know"),
    }


def input_ports(config: TaskConfig) -> dict[str, Port]:
    """The policy's inputs, in order."""
    size = sum(part.size for part in state_parts(config).values())
    return readings(joints_of(config)) | {"state": Port(size, "-", "state_next of the call before; zeros at first")}


def output_ports(config: TaskConfig) -> dict[str, Port]:
    """The policy's outputs, in order."""
    kept = input_ports(config)["state"]._replace(meaning="kept for the next call")
    return results(joints_of(config)) | {"state_next": kept}


def state_parts(config: TaskConfig) -> dict[str, Part]:
    """Parts of the state, in the order of its columns."""
    observation, joints = config.observation, joints_of(config)
    frame = sum(width(POLICY[name].size, joints) for name in observation.policy)
    parts = {
        "started": Part(1, "0 or 1", "1 after the first call"),
        "action": Part(joints, "1", "the last action"),
        "turned": Part(1, "0 or 1", "the ball was seen moving away"),
        "age": Part(1, "s", "of the ball's last frame"),
        "track": Part(3 * config.predictor.frames, "m", "the ball's last positions, oldest first"),
        "history": Part((observation.policy_history - 1) * frame, "-", "the last observations, oldest first"),
    }
    for name, entry in observed(observation).items():
        own = entry.make.parts(joints).items()
        parts |= {f"{name}.{part}": described for part, described in own}
    return parts


class DeployedPolicy(nn.Module):
    """Normaliser, predictor and actor, and the on-board estimators between a robot's raw readings and them.

    Inputs in the order of :func:`input_ports`, outputs in the order of :func:`output_ports`, each (N, size) float32.

    Args: policy as :func:`pace.rl.load_policy` gives it; model of the robot, for the paddle's kinematics.
    Errors: ``TypeError`` for a built-in policy, which is no network; :class:`pace.config.ConfigError` for unknown
    observations.
    """

    nominal: Tensor

    def __init__(self, policy: TaskPolicy, model: mujoco.MjModel) -> None:
        super().__init__()
        if not isinstance(policy.act, nn.Module):
            raise TypeError(f"policy {policy.source} is no network: only a saved policy can be deployed")
        config = policy.config
        check_policy(config)
        self.policy = policy.act
        self.onboard = Onboard(config, PaddleChain(model, RobotSpec.of(config.robot).paddle), policy.predictor)
        self.seen = [POLICY[name].function for name in config.observation.policy]
        self.history = config.observation.policy_history
        self.state = StateLayout(config)
        self.action_scale, self.action_clip = config.robot.action_scale, config.robot.action_clip
        self.register_buffer("nominal", torch.tensor(nominal_pose(config.robot), dtype=torch.float32))

    def forward(
        self,
        base_angular_velocity: Tensor,
        base_position: Tensor,
        projected_gravity: Tensor,
        heading: Tensor,
        joint_position: Tensor,
        joint_velocity: Tensor,
        ball_position: Tensor,
        base_age: Tensor,
        base_new: Tensor,
        ball_age: Tensor,
        ball_new: Tensor,
        state: Tensor,
    ) -> tuple[Tensor, ...]:
        """One control step; see the class."""
        body = (base_angular_velocity, base_position, projected_gravity, heading)
        stamps = (base_age[:, 0], base_new[:, 0] > 0.5, ball_age[:, 0], ball_new[:, 0] > 0.5)
        sensing = Readings(*body, joint_position - self.nominal, joint_velocity, ball_position, *stamps)
        past = self.state.split(state)
        started = past["started"] > 0.5
        track = Track(past["track"], past["turned"][:, 0] > 0.5, started[:, 0], past["age"][:, 0])
        estimates = {name: past[name] for name in self.onboard.estimates}
        seen = self.onboard(sensing, past["action"], track, estimates, started[:, 0])
        frame = torch.cat([function(seen).float() for function in self.seen], dim=1)
        older = torch.where(started, past["history"], frame.repeat(1, self.history - 1))
        observation = torch.cat((older, frame), dim=1)
        action = self.policy(observation).clamp(-self.action_clip, self.action_clip)
        target = self.nominal + self.action_scale * action
        kept = self._state(seen, action, observation[:, frame.shape[1] :])
        flags = (seen.time.unsqueeze(1), seen.track.something_to_hit.unsqueeze(1).float())
        return target, action, seen.apex, seen.target, *flags, kept

    def _state(self, seen: Signals, action: Tensor, history: Tensor) -> Tensor:
        """``state_next`` (N, S)."""
        parts = {
            "started": torch.ones_like(action[:, :1]),
            "action": action,
            "turned": seen.track.turned.unsqueeze(1).float(),
            "age": seen.track.age.unsqueeze(1),
            "track": seen.track.positions,
            "history": history,
        }
        return self.state.join(parts | seen.estimates)


class StateLayout:
    """Columns of each part in the state (N, ``size``): those of :func:`state_parts`, an estimate's as one.

    Attributes: ``columns`` part or estimate -> columns.
    """

    def __init__(self, config: TaskConfig) -> None:
        parts = columns(state_parts(config))
        self.columns = {name: where for name, where in parts.items() if "." not in name}
        for estimate in observed(config.observation):
            own = [parts[f"{estimate}.{part}"] for part in ESTIMATES[estimate].make.parts(joints_of(config))]
            self.columns[estimate] = slice(own[0].start, own[-1].stop)
        self.size = max(where.stop for where in self.columns.values())

    def split(self, state: Tensor) -> dict[str, Tensor]:
        """Each part (N, size) of the state."""
        return {name: state[:, where] for name, where in self.columns.items()}

    def join(self, parts: Mapping[str, Tensor]) -> Tensor:
        """The state (N, S) of all parts."""
        return torch.cat([parts[name] for name in self.columns], dim=1)
