"""Reward terms of the robot: its posture, joints and feet."""

from __future__ import annotations

import torch
from torch import Tensor

from pace.task.reward_terms import TERMS, Params, RewardFunction, length, term
from pace.task.state import TaskState

#: Terms that are a measure as it stands (:class:`pace.task.measures.Measures`): name -> measure.
MEASURED = {
    "base_vertical_velocity": "vertical_velocity",  # squared, (m/s)^2
    "base_roll_pitch_rate": "roll_pitch_rate",  # squared, (rad/s)^2
    "base_yaw_rate": "yaw_rate",  # squared, (rad/s)^2
    "base_tilt": "base_tilt",  # squared horizontal part of gravity in the body frame
    "undesired_contact": "contacts",  # number of bodies other than the feet that touch something
    "joint_power": "joint_power",  # norm over the joints of torque times velocity, W
    "ankle_power": "ankle_power",  # the same over the ankles
    "joint_acceleration": "joint_acceleration",  # squared, summed over the joints, (rad/s^2)^2
    "action_rate": "action_change",  # squared change of the action, summed over the joints
    # sum of |joint - nominal|, rad; the first: hip yaw and roll, waist and left arm without its shoulder roll
    "deviation_hip_waist_left_arm": "hip_waist_left_arm",
    "deviation_left_shoulder_roll": "left_shoulder_roll",
    "deviation_right_arm": "right_arm",
    "foot_tilt": "foot_tilt",  # squared horizontal part of the soles' normals, summed over the feet
    "foot_slide": "foot_slide",  # horizontal speed of the feet in contact, summed, m/s
}


def measured(name: str) -> RewardFunction:
    """The term that is the measure ``name``."""
    return RewardFunction(lambda state, params: state.measures[name], ())


for _name, _measure in MEASURED.items():
    TERMS.enter(_name, measured(_measure))


@term("x", "margin", "sigma")
def table_proximity(state: TaskState, params: Params) -> Tensor:
    """exp(-abs(base x - (x - margin)) / sigma^2): a wall of penalty before the table's edge at x, m."""
    distance = (state.robot.base_position[:, 0] - (params["x"] - params["margin"])).abs_()
    return distance.mul_(-1.0 / params["sigma"] ** 2).exp_()


@term()
def fall(state: TaskState, params: Params) -> Tensor:
    """The robot fell or left its area: the episode is lost."""
    return state.lost.float()


@term("distance")
def paddle_near_head(state: TaskState, params: Params) -> Tensor:
    """How much nearer than ``distance`` the paddle is to the head, m."""
    return (params["distance"] - state.measures["paddle_to_head"]).clamp(min=0.0)


@term("fraction")
def joint_limits(state: TaskState, params: Params) -> Tensor:
    """How far joints are beyond the inner ``fraction`` of their range, summed, rad."""
    middle, reach = state.joint_range
    return (state.robot.joint_position - middle).abs_().sub_(reach, alpha=params["fraction"]).clamp_(min=0.0).sum(1)


@term()
def both_feet_air(state: TaskState, params: Params) -> Tensor:
    """No foot touches the floor."""
    return (state.measures["feet_down"] == 0.0).float()


def _ready(state: TaskState, params: Params) -> Tensor:
    """There is nothing to hit and the base is within ``reach`` m of where it should stand, (N,) bool."""
    return ~state.something_to_hit & (length(state.base_error) < params["reach"])


@term("reach", "sigma")
def ready_stance(state: TaskState, params: Params) -> Tensor:
    """Still feet where there is nothing to hit and the base is within ``reach`` m of where it should stand.

    exp(-v / sigma), v the speeds of both feet summed, m/s: stepping on the spot earns less than standing.
    """
    speed = length(state.robot.foot_velocity).sum(1)
    return torch.exp(speed * (-1.0 / params["sigma"])) * _ready(state, params)


@term("reach", "sigma")
def ready_joints(state: TaskState, params: Params) -> Tensor:
    """Still joints at the same time: exp(-w / sigma), w the root mean square of the joints' speeds, rad/s."""
    speed = state.robot.joint_velocity.square().mean(1).sqrt_()
    return torch.exp(speed * (-1.0 / params["sigma"])) * _ready(state, params)


@term("reach", "height")
def ready_height(state: TaskState, params: Params) -> Tensor:
    """How much lower than ``height`` the base is at the same time, m."""
    return (params["height"] - state.robot.base_position[:, 2]).clamp(min=0.0) * _ready(state, params)


@term("threshold", "limit")
def foot_force(state: TaskState, params: Params) -> Tensor:
    """Force of each foot beyond ``threshold``, at most ``limit``, summed over the feet, N."""
    return (state.foot_load - params["threshold"]).clamp(0.0, params["limit"]).sum(1)


@term("ratio")
def foot_stumble(state: TaskState, params: Params) -> Tensor:
    """A foot meets something upright: horizontal force above ``ratio`` times the vertical one."""
    return (state.measures["foot_steepness"] > params["ratio"]).float()


@term("distance")
def feet_near(state: TaskState, params: Params) -> Tensor:
    """How much nearer than ``distance`` the feet are to each other, m."""
    return (params["distance"] - state.feet_distance).clamp(min=0.0)


@term("distance")
def feet_too_near(state: TaskState, params: Params) -> Tensor:
    """The same, with a second threshold."""
    return feet_near(state, params)
