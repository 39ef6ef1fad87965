"""Quantities that rewards and the critic share, of N worlds, and the kernels' structs of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pace.arrays.tensors import Bool, Float, Vec2, Vec3, struct_of


@dataclass(eq=False)
class Derived:
    """Quantities derived from robot, ball and game; they change with a new serve. World frame."""

    base_error: Vec2  # m, from the base to its target, for the rewards
    shift: Vec2  # m, the same for the networks
    apex: Vec3  # m, the idle point if there is nothing to hit
    target: Vec3  # m, the same
    arrival: Float  # s until the ball is at the target, 0 if there is nothing to hit
    foot_load: Annotated[Float, "feet"]  # N
    foot_contact: Annotated[Bool, "feet"]
    feet_distance: Float  # m
    paddle_to_target: Vec3  # m
    joint_offset: Annotated[Float, "joints"]  # rad from the nominal pose
    serve_progress: Float  # share of the longest serve
    episode_progress: Float  # share of the episode's serves, 0 if episodes do not end


@struct_of(Derived)
class DerivedArrays:
    """:class:`Derived` in the kernels' form."""


@dataclass(eq=False)
class Measures:
    """Quantities of the robots for the reward terms."""

    joint_power: Float  # W, norm over the joints of torque times velocity
    ankle_power: Float  # W, of the ankles alone
    joint_acceleration: Float  # (rad/s^2)^2, sum of squares
    action_change: Float  # sum of squares
    hip_waist_left_arm: Float  # rad, sum of |joint - nominal| over a group of ``JOINT_GROUPS``
    left_shoulder_roll: Float  # rad, the same
    right_arm: Float  # rad, the same
    foot_tilt: Float  # squared horizontal part of the soles' normals, summed
    foot_slide: Float  # m/s, horizontal speed of the feet in contact, summed
    foot_steepness: Float  # largest horizontal over vertical force of a foot in contact
    paddle_to_head: Float  # m
    paddle_to_target: Float  # m
    base_to_target: Float  # m
    vertical_velocity: Float  # (m/s)^2, square of the base's
    roll_pitch_rate: Float  # (rad/s)^2, squares of the base's
    yaw_rate: Float  # (rad/s)^2, square of the base's
    base_tilt: Float  # squared horizontal part of gravity in the body frame
    contacts: Float  # of bodies other than the feet
    feet_down: Float  # number of feet in contact


@struct_of(Measures)
class MeasureArrays:
    """:class:`Measures` in the kernels' form."""
