"""The state of N robots for sensors, task and rewards, and the kernels' struct of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pace.arrays.tensors import Float, Vec2, Vec3, Vec4, struct_of

Joints = Annotated[Float, "joints"]
Feet = Annotated[Vec3, "feet"]  # (N, 2, 3), left and right


@dataclass(frozen=True)
class RobotState:
    """The robot at the end of the last control step: tensors (N, ...), float32, world frame unless stated.

    The tensors are allocated once and overwritten by each step. Contact forces, body contacts and joint torques belong
    to the last physics step.
    """

    joint_position: Joints  # rad
    joint_velocity: Joints  # rad/s
    joint_acceleration: Joints  # rad/s^2, mean over the control step
    joint_torque: Joints  # N m
    base_position: Vec3  # m
    base_quat: Vec4  # w, x, y, z
    base_linear_velocity: Vec3  # m/s
    base_angular_velocity: Vec3  # rad/s, body frame
    projected_gravity: Vec3  # unit vector, body frame
    heading: Vec2  # the base's x axis on the ground, unit vector
    paddle_position: Vec3  # m, centre of the blade
    paddle_normal: Vec3  # unit vector
    paddle_velocity: Vec3  # m/s
    foot_position: Feet  # m
    foot_velocity: Feet  # m/s
    foot_up: Feet  # unit vector, the foot's z axis
    foot_force: Feet  # N
    body_contact: Annotated[Float, "bodies"]  # 1 if a body other than the feet touches something
    head_position: Vec3  # m


@struct_of(RobotState)
class RobotArrays:
    """:class:`RobotState` in the kernels' form."""
