"""Reward terms of the robot: its posture, joints and feet."""

from __future__ import annotations

import torch
from torch import Tensor

from pace.task.reward_terms import Params, length, term
from pace.task.state import TaskState

# --- posture and motion of the base -----------------------------------------------------------------------------------


@term()
def base_vertical_velocity(state: TaskState, params: Params) -> Tensor:
    """Squared, (m/s)^2."""
    return state.measures["vertical_velocity"]


@term()
def base_roll_pitch_rate(state: TaskState, params: Params) -> Tensor:
    """Squared, (rad/s)^2."""
    return state.measures["roll_pitch_rate"]


@term()
def base_yaw_rate(state: TaskState, params: Params) -> Tensor:
    """Squared, (rad/s)^2."""
    return state.measures["yaw_rate"]


@term()
def base_tilt(state: TaskState, params: Params) -> Tensor:
    """Squared horizontal part of gravity in the body frame."""
    return state.measures["base_tilt"]


@term("x", "margin", "sigma")
def table_proximity(state: TaskState, params: Params) -> Tensor:
    """exp(-abs(base x - (x - margin)) / sigma^2): a wall of penalty before the table's edge at x, m."""
    distance = (state.robot.base_position[:, 0] - (params["x"] - params["margin"])).abs_()
    return distance.mul_(-1.0 / params["sigma"] ** 2).exp_()


@term()
def fall(state: TaskState, params: Params) -> Tensor:
    """The robot fell or left its area: the episode is lost."""
    return state.lost.float()


@term()
def undesired_contact(state: TaskState, params: Params) -> Tensor:
    """Number of bodies other than the feet that touch something."""
    return state.measures["contacts"]


@term("distance")
def paddle_near_head(state: TaskState, params: Params) -> Tensor:
    """How much nearer than ``distance`` the paddle is to the head, m."""
    return (params["distance"] - state.measures["paddle_to_head"]).clamp(min=0.0)


# --- joints -----------------------------------------------------------------------------------------------------------


@term()
def joint_power(state: TaskState, params: Params) -> Tensor:
    """Norm over the joints of torque times velocity, W."""
    return state.measures["joint_power"]


@term()
def ankle_power(state: TaskState, params: Params) -> Tensor:
    """The same over the ankles."""
    return state.measures["ankle_power"]


@term()
def joint_acceleration(state: TaskState, params: Params) -> Tensor:
    """Squared, summed over the joints, (rad/s^2)^2."""
    return state.measures["joint_acceleration"]


@term()
def action_rate(state: TaskState, params: Params) -> Tensor:
    """Squared change of the action, summed over the joints."""
    return state.measures["action_change"]


@term("fraction")
def joint_limits(state: TaskState, params: Params) -> Tensor:
    """How far joints are beyond the inner ``fraction`` of their range, summed, rad."""
    middle, reach = state.joint_range
    return (state.robot.joint_position - middle).abs_().sub_(reach, alpha=params["fraction"]).clamp_(min=0.0).sum(1)


@term()
def deviation_hip_waist_left_arm(state: TaskState, params: Params) -> Tensor:
    """Sum of |joint - nominal| over hip yaw and roll, waist and left arm without its shoulder roll, rad."""
    return state.measures["hip_waist_left_arm"]


@term()
def deviation_left_shoulder_roll(state: TaskState, params: Params) -> Tensor:
    """|joint - nominal|, rad."""
    return state.measures["left_shoulder_roll"]


@term()
def deviation_right_arm(state: TaskState, params: Params) -> Tensor:
    """Sum of |joint - nominal|, rad."""
    return state.measures["right_arm"]


# --- feet -------------------------------------------------------------------------------------------------------------


@term()
def both_feet_air(state: TaskState, params: Params) -> Tensor:
    """No foot touches the floor."""
    return (state.measures["feet_down"] == 0.0).float()


@term()
def foot_tilt(state: TaskState, params: Params) -> Tensor:
    """Squared horizontal part of the soles' normals, summed over the feet."""
    return state.measures["foot_tilt"]


@term()
def foot_slide(state: TaskState, params: Params) -> Tensor:
    """Horizontal speed of the feet in contact, summed, m/s."""
    return state.measures["foot_slide"]


@term("reach", "sigma")
def ready_stance(state: TaskState, params: Params) -> Tensor:
    """Still feet where there is nothing to hit and the base is within ``reach`` m of where it should stand.

    exp(-v / sigma), v the speeds of both feet summed, m/s: stepping on the spot earns less than standing.
    """
    ready = ~state.something_to_hit & (length(state.base_error) < params["reach"])
    return torch.exp(length(state.robot.foot_velocity).sum(1) * (-1.0 / params["sigma"])) * ready


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
