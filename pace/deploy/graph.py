"""The policy as a robot runs it: from histories of raw sensor readings to joint targets, in one network.

What :mod:`pace.task.observations` computes step by step in N worlds is computed here at once for every frame of the
history: the ball's track, the prediction, whether there is anything to hit, the paddle's pose. What cannot be read off
a short history goes out of one call and into the next: the last actions, whether the ball was seen moving away before,
and, for a policy that observes them, what the robot remembers of its returns.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import torch
from torch import Tensor, nn

from pace.config.task import TaskConfig
from pace.onboard.kernels import ATTITUDE_SIZE, DELAY_SIZE, MEMORY_SIZE
from pace.onboard.returns import SEEN
from pace.onboard.steps import AttitudeEstimateStep, DelayEstimateStep, JointEstimateStep, ReturnMemoryStep
from pace.predictor.network import BallPredictor
from pace.rl.policies import TaskPolicy
from pace.sim.robot import nominal_pose
from pace.task.game import idle_point
from pace.task.game_kernels import LONGEST_TIME
from pace.task.observations import JOINTS, check_policy

PADDLE_SITE = "paddle"
SMALLEST_LENGTH = 1e-9  # a direction shorter than this has none


class Port(NamedTuple):
    """An input or output of the network: numbers a frame, unit, meaning."""

    size: int
    unit: str
    meaning: str


#: Inputs (N, frames, size) of every policy, oldest frame first; :func:`input_shapes` says how many frames.
INPUTS = {
    "base_angular_velocity": Port(3, "rad/s", "gyroscope of the trunk, body frame"),
    "base_position": Port(3, "m", "trunk, world frame"),
    "projected_gravity": Port(3, "1", "direction of gravity in the body frame; upright: (0, 0, -1)"),
    "heading": Port(2, "1", "x axis of the trunk on the ground, world frame; towards the opponent: (1, 0)"),
    "joint_position": Port(JOINTS, "rad", "in the order of joint_names, not relative to the nominal pose"),
    "joint_velocity": Port(JOINTS, "rad/s", "in the order of joint_names"),
    "previous_action": Port(JOINTS, "1", "the output action of the calls before; zeros before the first one"),
    "ball_position": Port(3, "m", "centre of the ball, world frame"),
    "ball_launched": Port(1, "0 or 1", "1 in the frame in which a new ball is seen first"),
    "ball_moved_away": Port(1, "0 or 1", "the output ball_moved_away_next of the call before; 0 at the first one"),
}
#: Outputs (N, size) of every policy.
OUTPUTS = {
    "joint_target": Port(JOINTS, "rad", "targets of the joints' position control until the next call"),
    "action": Port(JOINTS, "1", "kept by the caller as previous_action of the next call"),
    "predicted_apex": Port(3, "m", "learned prediction, or the point to stand by while there is nothing to hit"),
    "predicted_target": Port(3, "m", "where the paddle is to meet the ball, likewise"),
    "predicted_time": Port(1, "s", "until the ball is at the target; 0 while there is nothing to hit"),
    "something_to_hit": Port(1, "0 or 1", "the ball can still be hit, as far as the robot can know"),
    "ball_moved_away_next": Port(1, "0 or 1", "kept by the caller for the next call"),
}
#: What a policy that observes it keeps over an episode: which of ``ObservationConfig`` says so, and the port, an input
#: of that name and an output ``<name>_next``; the meaning is that of the output.
EPISODE = {
    "return_memory": (
        "memory",
        Port(
            MEMORY_SIZE,
            "m, m/s, 1",
            "; the last five: velocity of the last return, restitution of paddle and ball above the prior, share of "
            "hits that it is known from",
        ),
    ),
    "delay_estimate": (
        "delay",
        Port(DELAY_SIZE, "rad, rad/s, s", "; the last: delay of motion capture above the prior"),
    ),
    "attitude": (
        "attitude",
        Port(ATTITUDE_SIZE, "1, rad/s", ": 1, estimated gravity and heading, angular velocity"),
    ),
    "joints": (
        "joints",
        Port(1 + 2 * JOINTS, "1, rad, rad/s", ": 1, estimated positions above the nominal pose, velocities"),
    ),
}
#: Input -> the output of the calls before that it is made of. An ONNX graph has one name space, hence the other names.
KEPT = {
    "previous_action": "action",
    "ball_moved_away": "ball_moved_away_next",
    **{name: f"{name}_next" for name in EPISODE},
}


def input_ports(config: TaskConfig) -> dict[str, Port]:
    """The policy's inputs, in order."""
    given = "the output {}_next of the calls before; zeros before the first one"
    return INPUTS | {name: port._replace(meaning=given.format(name)) for name, port in _of_episode(config).items()}


def output_ports(config: TaskConfig) -> dict[str, Port]:
    """The policy's outputs, in order."""
    kept = _of_episode(config).items()
    return OUTPUTS | {
        f"{name}_next": port._replace(meaning=f"kept by the caller as {name} of the next call{port.meaning}")
        for name, port in kept
    }


def _of_episode(config: TaskConfig) -> dict[str, Port]:
    """Those of ``EPISODE`` that the policy observes."""
    observation = config.observation
    return {name: port for name, (numbers, port) in EPISODE.items() if getattr(observation, numbers) is not None}


def kept_outputs(config: TaskConfig) -> dict[str, str]:
    """Input -> output of the call before that is its newest frame; zeros before the first call."""
    return {name: output for name, output in KEPT.items() if name in input_ports(config)}


def input_shapes(config: TaskConfig) -> dict[str, tuple[int, int]]:
    """(frames, size) of each input. The ball's history is longer: the first frame has its own track."""
    frames = config.observation.policy_history
    longer = frames + config.predictor.frames - 1
    count = {"ball_position": longer, "ball_launched": longer, "ball_moved_away": 1}
    return {name: (count.get(name, frames), port.size) for name, port in input_ports(config).items()}


class PaddleChain(nn.Module):
    """Forward kinematics of the paddle, in torch: the chain of bodies from the trunk to it."""

    def __init__(self, model: mujoco.MjModel) -> None:
        super().__init__()
        body = int(model.site(PADDLE_SITE).bodyid[0])
        path: list[int] = []
        while body != int(model.jnt_bodyid[0]):
            path.insert(0, body)
            body = int(model.body_parentid[body])
        joints = [int(model.body_jntadr[body]) for body in path]
        if min(joints) < 1 or model.jnt_pos[joints].any():
            raise ValueError("every body between trunk and paddle must have one joint, at its origin")
        self.joints = [joint - 1 for joint in joints]  # index in RobotSpec.joints: joint 0 is the free one
        rotations = [_matrix(model.body_quat[body]) for body in path]
        self.register_buffer("offsets", torch.tensor(model.body_pos[path], dtype=torch.float32))
        self.register_buffer("rotations", torch.stack(rotations))
        self.register_buffer("axes", torch.stack([_cross_matrix(model.jnt_axis[joint]) for joint in joints]))
        self.register_buffer("tip", torch.tensor(model.site(PADDLE_SITE).pos, dtype=torch.float32))

    offsets: Tensor
    rotations: Tensor
    axes: Tensor
    tip: Tensor

    def forward(self, position: Tensor, rotation: Tensor, joint_position: Tensor) -> tuple[Tensor, Tensor]:
        """Base position (..., 3) m, its rotation matrix (..., 3, 3), joints (..., J) rad -> centre, normal (..., 3)."""
        unit = torch.eye(3, device=position.device)
        for link, joint in enumerate(self.joints):
            angle = joint_position[..., joint, None, None]
            axis = self.axes[link]  # Rodrigues: R = 1 + sin K + (1 - cos) K K
            turn = unit + angle.sin() * axis + (1.0 - angle.cos()) * (axis @ axis)
            position = position + rotation @ self.offsets[link]
            rotation = rotation @ self.rotations[link] @ turn
        return position + rotation @ self.tip, rotation[..., :, 0]


def _matrix(quat: object) -> Tensor:
    """Rotation matrix of a quaternion w, x, y, z."""
    flat = torch.zeros(9, dtype=torch.float64).numpy()
    mujoco.mju_quat2Mat(flat, quat)
    return torch.tensor(flat, dtype=torch.float32).view(3, 3)


def _cross_matrix(axis: object) -> Tensor:
    """K with K v = axis x v."""
    x, y, z = (float(value) for value in axis)  # type: ignore[attr-defined]
    return torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def base_rotation(gravity: Tensor, heading: Tensor) -> Tensor:
    """Rotation matrix (..., 3, 3) of the base, R = Rz Ry Rx: roll and pitch from gravity, yaw from heading.

    Args: gravity (..., 3) in the body frame, heading (..., 2); neither needs to have length one.
    """
    across = gravity[..., 1:].square().sum(-1).sqrt()
    length = torch.clamp(gravity.square().sum(-1).sqrt(), min=SMALLEST_LENGTH)
    sin_roll, cos_roll = (-gravity[..., i] / torch.clamp(across, min=SMALLEST_LENGTH) for i in (1, 2))
    sin_pitch, cos_pitch = gravity[..., 0] / length, across / length
    ground = torch.clamp(heading.square().sum(-1).sqrt(), min=SMALLEST_LENGTH)
    cos_yaw, sin_yaw = heading[..., 0] / ground, heading[..., 1] / ground
    rows = (
        cos_yaw * cos_pitch,
        cos_yaw * sin_pitch * sin_roll - sin_yaw * cos_roll,
        cos_yaw * sin_pitch * cos_roll + sin_yaw * sin_roll,
        sin_yaw * cos_pitch,
        sin_yaw * sin_pitch * sin_roll + cos_yaw * cos_roll,
        sin_yaw * sin_pitch * cos_roll - cos_yaw * sin_roll,
        -sin_pitch,
        cos_pitch * sin_roll,
        cos_pitch * cos_roll,
    )
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


class BallTracks(nn.Module):
    """The predictor's input at each frame of the history, and whether there is anything to hit there."""

    def __init__(self, config: TaskConfig) -> None:
        super().__init__()
        self.frames = config.predictor.frames
        self.rule = dict(config.reward.nothing_to_hit)
        self.moved = config.sensing.moved

    def forward(self, position: Tensor, launched: Tensor, moved_away: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions (N, L, 3) m, flags (N, L, 1) and (N, 1, 1) -> tracks (N, H, 3 frames), something to hit (N, H)
        bool, and moved away (N, H) bool. L = H + frames - 1.
        """
        track = position[:, :1].repeat(1, self.frames, 1)
        gone = moved_away[:, 0] > 0.5
        tracks, hittable, bits = [], [], []
        for frame in range(position.shape[1]):
            newest = position[:, frame : frame + 1]
            new = launched[:, frame] > 0.5
            track = torch.where(new.unsqueeze(-1), newest, torch.cat((track[:, 1:], newest), dim=1))
            if frame < self.frames - 1:
                continue
            change = track[:, -1] - track[:, -3]
            gone = (change[:, :1] > self.moved) | (gone & ~new)
            tracks.append(track.flatten(1))
            hittable.append(~(gone | self._nothing_to_hit(track[:, -1], change)))
            bits.append(gone)
        return torch.stack(tracks, dim=1), torch.cat(hittable, dim=1), torch.cat(bits, dim=1)

    def _nothing_to_hit(self, position: Tensor, change: Tensor) -> Tensor:
        x, z = position[:, :1], position[:, 2:]
        gone = (x < self.rule["past_x"]) | (change[:, :1] > self.moved) | (z < self.rule["low_z"])
        return gone | ((x < self.rule["falling_x"]) & (change[:, 2:] < 0.0))


class Prediction(NamedTuple):
    """What the actor believes at each frame: apex, target (N, H, 3) m, time (N, H, 1) s, base shift (N, H, 2) m."""

    apex: Tensor
    target: Tensor
    time: Tensor
    shift: Tensor


class PredictionReader(nn.Module):
    """The predictor, and what the actor sees of its output; zeros without a predictor (ablation)."""

    def __init__(self, config: TaskConfig, predictor: BallPredictor | None) -> None:
        super().__init__()
        reward = config.reward
        self.predictor = predictor if config.predictor.enabled else None
        self.intercept, self.target_x = reward.target_mode == "intercept", reward.target_x
        self.register_buffer("arm_offset", torch.tensor(reward.arm_offset))
        self.register_buffer("idle_base", torch.tensor(reward.idle_base_xy))
        self.register_buffer("idle_point", torch.tensor(idle_point(reward)))

    arm_offset: Tensor
    idle_base: Tensor
    idle_point: Tensor

    def forward(self, tracks: Tensor, hittable: Tensor, base_position: Tensor) -> Prediction:
        """Tracks (N, H, 3 frames) m, something to hit (N, H) bool, base (N, H, 3) m."""
        hit = hittable.unsqueeze(-1)
        if self.predictor is None:
            zero = torch.zeros_like(base_position)
            return Prediction(zero, zero, zero[..., :1], zero[..., :2])
        parts = self._parts(self.predictor, tracks)
        apex, target = (torch.where(hit, part, self.idle_point) for part in (parts["apex"], parts["target"]))
        time = torch.where(hit, parts["target_time"].clamp(0.0, LONGEST_TIME), 0.0)
        above = (target if self.intercept else apex)[..., :2]
        stand = torch.where(hit, above + self.arm_offset, self.idle_base)
        return Prediction(apex, target, time, stand - base_position[..., :2])

    def _parts(self, predictor: BallPredictor, tracks: Tensor) -> dict[str, Tensor]:
        output = predictor(tracks.flatten(0, 1)).unflatten(0, tracks.shape[:2])
        parts = {name: output[..., columns] for name, columns in predictor.slices.items()}
        apex = parts["apex"]
        if "target" not in parts:
            parts["target"] = torch.cat((apex[..., :1].clamp(max=self.target_x), apex[..., 1:]), dim=-1)
        if "target_time" not in parts:
            parts["target_time"] = torch.zeros_like(apex[..., :1])
        return parts


class DeployedPolicy(nn.Module):
    """Normaliser, predictor and actor, and all that lies between a robot's raw readings and them.

    Inputs in the order of :func:`input_ports`, each (N, frames, size) float32 as :func:`input_shapes` says; outputs in
    the order of :func:`output_ports`, each (N, size).

    Args: policy as :func:`pace.rl.load_policy` gives it; model of the robot, for the paddle's kinematics.
    Errors: ``TypeError`` for a built-in policy, which is no network; :class:`pace.config.ConfigError` for observations
    that nobody computes.
    """

    def __init__(self, policy: TaskPolicy, model: mujoco.MjModel) -> None:
        super().__init__()
        if not isinstance(policy.act, nn.Module):
            raise TypeError(f"policy {policy.source} is no network: only a saved policy can be deployed")
        config = policy.config
        check_policy(config.observation, config.predictor)
        self.policy = policy.act
        self.tracks = BallTracks(config)
        self.reader = PredictionReader(config, policy.predictor)
        self.chain = PaddleChain(model)
        numbers = config.observation.memory
        self.memory = ReturnMemoryStep(numbers, config.robot.control_dt) if numbers else None
        numbers = config.observation.delay
        self.delay = DelayEstimateStep(numbers, config.robot.control_dt) if numbers else None
        numbers = config.observation.attitude
        self.attitude = AttitudeEstimateStep(numbers, config.robot.control_dt) if numbers else None
        numbers = config.observation.joints
        self.joints = JointEstimateStep(numbers, config.robot.control_dt) if numbers else None
        self.kept = list(_of_episode(config))
        self.names = list(config.observation.policy)
        self.action_scale, self.action_clip = config.robot.action_scale, config.robot.action_clip
        self.register_buffer("nominal", torch.tensor(nominal_pose(config.robot), dtype=torch.float32))

    nominal: Tensor

    def forward(
        self,
        base_angular_velocity: Tensor,
        base_position: Tensor,
        projected_gravity: Tensor,
        heading: Tensor,
        joint_position: Tensor,
        joint_velocity: Tensor,
        previous_action: Tensor,
        ball_position: Tensor,
        ball_launched: Tensor,
        ball_moved_away: Tensor,
        *kept: Tensor,
    ) -> tuple[Tensor, ...]:
        """See the class; ``kept``: what is remembered, where the policy observes it."""
        tracks, hittable, moved_away = self.tracks(ball_position, ball_launched, ball_moved_away)
        prediction = self.reader(tracks, hittable, base_position)
        past, new = dict(zip(self.kept, kept, strict=True)), dict[str, Tensor]()
        sensed = (base_angular_velocity[:, -1], projected_gravity[:, -1], heading[:, -1])
        down, ahead = projected_gravity, heading
        if self.attitude is not None:
            new["attitude"] = self.attitude(past["attitude"][:, -1], *sensed)
            down, ahead = _since_first(_with_newest(past["attitude"], new["attitude"]))[..., 1:6].split([3, 2], dim=-1)
        rotation = base_rotation(down, ahead)
        bent = joint_position - self.nominal
        turning = joint_velocity
        if self.joints is not None:
            new["joints"] = self.joints(past["joints"][:, -1], bent[:, -1], turning[:, -1])
            known = _since_first(_with_newest(past["joints"], new["joints"]))[..., 1:]
            bent, turning = known.split(bent.shape[-1], dim=-1)
        paddle, normal = self.chain(base_position, rotation, bent + self.nominal)
        frames = {
            "base_angular_velocity": base_angular_velocity,
            "base_position": base_position,
            "projected_gravity": projected_gravity,
            "joint_position": joint_position - self.nominal,
            "joint_velocity": joint_velocity,
            "previous_action": previous_action,
            "ball_position": ball_position[:, -base_position.shape[1] :],
            "heading": heading,
            "predicted_apex": prediction.apex,
            "predicted_base_shift": prediction.shift,
            "sensed_paddle_to_target": prediction.target - paddle,
            "sensed_paddle_normal": normal,
            "predicted_time": prediction.time,
            "something_to_hit": hittable.unsqueeze(-1).float(),
        }
        if self.attitude is not None:
            frames |= {"estimated_gravity": down, "estimated_heading": ahead}
        if self.joints is not None:
            frames |= {"estimated_joint_position": bent, "estimated_joint_velocity": turning}
        if self.memory is not None:
            hit = (tracks[:, -1], moved_away[:, -1:], paddle[:, -1], normal[:, -1])
            new["return_memory"] = self.memory(past["return_memory"][:, -1], *hit)
            frames["last_return"] = _with_newest(past["return_memory"], new["return_memory"])[..., -SEEN:]
        if self.delay is not None:
            new["delay_estimate"] = self.delay(past["delay_estimate"][:, -1], *sensed)
            frames["sensed_delay"] = _with_newest(past["delay_estimate"], new["delay_estimate"])[..., -1:]
        observation = torch.cat([frames[name] for name in self.names], dim=-1).flatten(1)
        action = self.policy(observation).clamp(-self.action_clip, self.action_clip)
        seen = (prediction.apex[:, -1], prediction.target[:, -1], prediction.time[:, -1])
        flags = (hittable[:, -1:].float(), moved_away[:, :1].float())  # the next history begins one frame later
        return self.nominal + self.action_scale * action, action, *seen, *flags, *(new[name] for name in self.kept)


def _with_newest(past: Tensor, newest: Tensor) -> Tensor:
    """What was kept (N, frames, size), each the newest of its call, and this call's; the oldest is dropped."""
    return torch.cat((past[:, 1:], newest.unsqueeze(1)), dim=1)


def _since_first(kept: Tensor) -> Tensor:
    """What was kept (N, frames, size), the first column 1; frames before the first call, all 0, become as that one."""
    frames = [kept[:, -1]]
    for frame in reversed(kept[:, :-1].unbind(1)):
        frames.insert(0, torch.where(frame[:, :1] > 0.5, frame, frames[0]))
    return torch.stack(frames, dim=1)
