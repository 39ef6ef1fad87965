"""What rewards and the critic share: quantities of N worlds, and the kernels' structs of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pace.arrays.tensors import Bool, Float, Vec2, Vec3, struct_of


@dataclass(eq=False)
class Derived:
    """What follows from robot, ball and game, and changes with a new serve. World frame."""

    base_error: Vec2  # m, from the base to where it should stand, for the rewards
    shift: Vec2  # m, the same as the networks see it
    apex: Vec3  # m, the point to stand by where there is nothing to hit
    target: Vec3  # m, the same
    arrival: Float  # s until the ball is at the target, 0 where there is nothing to hit
    foot_load: Annotated[Float, "feet"]  # N
    foot_contact: Annotated[Bool, "feet"]
    feet_distance: Float  # m
    paddle_to_target: Vec3  # m
    joint_offset: Annotated[Float, "joints"]  # rad from the nominal pose
    serve_progress: Float  # share of the longest serve
    episode_progress: Float  # share of the episode's serves, 0 where episodes do not end


@struct_of(Derived)
class DerivedArrays:
    """:class:`Derived` as kernels see it."""


@dataclass(eq=False)
class Measures:
    """What reward terms measure on robots."""

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
    """:class:`Measures` as kernels see it."""
