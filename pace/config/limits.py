"""The range in which each number of the configuration means anything, checked when it is read.

A range is generous: it holds every body, ball and learner that could be tried, and leaves out what has no meaning (a
negative friction, a year per control step) or what the machine cannot hold. Relations between keys are checked by the
dataclasses themselves. A list, or the values of a table, has the range of its key.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

Limits = tuple[float, float]

TINY = 1e-9  # in place of zero, which is excluded
SHARE: Limits = (0.0, 1.0)
SIGNED_SHARE: Limits = (-1.0, 1.0)
COUNT: Limits = (1, 10**9)
SIZE: Limits = (1, 65_536)  # units of a layer, numbers in an observation
COEFFICIENT: Limits = (0.0, 10.0)
ADDED: Limits = (-10.0, 10.0)  # to a coefficient
FACTOR: Limits = (0.0, 100.0)
PLACE: Limits = (-100.0, 100.0)  # m
SPEED: Limits = (-200.0, 200.0)  # m/s
SPIN: Limits = (-10_000.0, 10_000.0)  # rad/s
ANGLE: Limits = (-100.0, 100.0)  # rad
SECONDS: Limits = (0.0, 1000.0)
MINUTES: Limits = (0.0, 1e7)
AMPLITUDE: Limits = (0.0, 100.0)
SEED: Limits = (0, 2**32 - 1)
SAMPLES: Limits = (0.0, 1e15)
ANY: Limits = (-1e9, 1e9)
STEP: Limits = (1e-5, 0.2)  # s, of physics or control

#: (class of the configuration, its key) -> least and largest value, both allowed.
LIMITS: dict[str, dict[str, Limits]] = {
    "RobotConfig": {
        "control_dt": (1e-3, 0.2), "action_scale": (0.0, 10.0), "action_clip": (TINY, 1e6), "armature": (0.0, 10.0),
        "base_height": (0.0, 10.0), "nominal_pose": ADDED, "reset_limits": ADDED, "stall_ratio": (0.0, 1000.0),
    },
    "JointGroup": {
        "kp": (0.0, 1e5), "kd": (0.0, 1e4), "effort": (1e-3, 1e5), "max_speed": (0.0, 1000.0), "armature": (0.0, 10.0),
        "friction": (0.0, 1000.0),
    },
    "TableConfig": {
        "length": (0.1, 100.0), "width": (0.1, 100.0), "height": (0.01, 10.0), "thickness": (1e-3, 1.0),
        "net_height": (0.0, 10.0), "net_overhang": (0.0, 10.0), "paddle_radius": (0.01, 1.0),
        "paddle_half_thickness": (1e-4, 0.1), "floor_restitution": SHARE, "floor_friction": COEFFICIENT,
        "net_restitution": SHARE, "net_friction": COEFFICIENT, "body_restitution": SHARE, "body_friction": COEFFICIENT,
        "push_force": (0.0, 1e6),
    },
    "DragRow": {"speed": FACTOR, "ratio": FACTOR, "coefficient": COEFFICIENT},
    "LiftRow": {
        "speed": FACTOR, "slope": SIGNED_SHARE, "offset": ADDED, "bend": (0.0, 10_000.0), "quadratic": SIGNED_SHARE,
        "linear": SIGNED_SHARE, "constant": ADDED,
    },
    "BallConfig": {
        "mass": (1e-4, 10.0), "radius": (1e-3, 0.2), "air_density": FACTOR, "drag_coefficient": COEFFICIENT,
        "magnus_coefficient": ADDED, "table_restitution": SHARE, "table_restitution_slope": SIGNED_SHARE,
        "table_friction": COEFFICIENT, "paddle_restitution": SHARE, "paddle_restitution_slope": SIGNED_SHARE,
        "paddle_friction": COEFFICIENT, "min_restitution": SHARE, "table_drag": COEFFICIENT, "table_lift": COEFFICIENT,
        "table_tangential_restitution": SIGNED_SHARE, "paddle_tangential_restitution": SIGNED_SHARE,
        "paddle_tangential_restitution_slope": SHARE, "paddle_drilling_loss": SHARE,
    },
    "RandomizationConfig": {
        "friction": COEFFICIENT, "trunk_mass": (-1000.0, 1000.0), "trunk_com": SIGNED_SHARE, "kp_scale": FACTOR,
        "kd_scale": FACTOR, "armature_scale": FACTOR, "effort_scale": (1e-3, 100.0), "actuator_delay": (0.0, 1.0),
        "push_velocity": PLACE, "push_interval": (0.0, 1e6), "ball_mass_scale": (0.01, 100.0), "drag_scale": FACTOR,
        "magnus": ADDED, "table_restitution": SIGNED_SHARE, "table_friction": ADDED, "paddle_restitution": SIGNED_SHARE,
        "paddle_friction": ADDED, "lift_scale": FACTOR, "table_tangential_restitution": (-2.0, 2.0),
        "paddle_tangential_restitution": (-2.0, 2.0), "paddle_drilling_loss": SIGNED_SHARE, "backlash": SHARE,
        "paddle_tilt": (0.0, 1.5), "paddle_shift": SHARE, "speed_scale": (1e-3, 100.0),
        "ankle_effort_scale": (1e-3, 100.0), "joint_friction": (0.0, 1000.0), "joint_damping": (0.0, 1000.0),
        "preset_share": SHARE,
    },
    "MocapConfig": {
        "rate": (0.0, 10_000.0), "white_noise": AMPLITUDE, "slow_noise": AMPLITUDE, "slow_noise_time": (TINY, 1000.0),
        "lost": SHARE, "gap_rate": FACTOR, "gap": SECONDS, "jitter": SECONDS, "occlusion": FACTOR,
    },
    "SensingConfig": {
        "base_angular_velocity": AMPLITUDE, "base_position": AMPLITUDE, "projected_gravity": AMPLITUDE,
        "joint_position": AMPLITUDE, "joint_velocity": AMPLITUDE, "ball_position": AMPLITUDE, "heading": AMPLITUDE,
        "base_shift": AMPLITUDE, "mocap_delay": SECONDS, "noise_scale": (0.0, 1000.0), "moved": FACTOR,
        "fastest_ball": (TINY, 1e6), "longest_gap": SECONDS,
    },
    "EngineConfig": {
        "physics_dt": STEP, "solver_iterations": (1, 1000), "line_search_iterations": (1, 1000), "threads": (0, 4096),
        "contacts_per_world": (1, 10_000), "constraints_per_world": (1, 100_000), "ball_dt": (1e-4, 1.0),
        "largest_speed": (0.0, 1e9), "remembered_steps": (0, 10_000),
    },
    "ServeConfig": {
        "x": PLACE, "y": PLACE, "z": PLACE, "vx": SPEED, "vy": SPEED, "vz": SPEED, "topspin": SPIN, "sidespin": SPIN,
        "corkscrew": SPIN, "max_duration": (1e-3, 1000.0), "end_after_hit": SECONDS, "end_height": PLACE,
        "serves_per_episode": (0, 10**6), "head_start": SECONDS, "attempts": (1, 1000), "speed": (0.0, 400.0),
        "bounce_x": PLACE, "bounce_y": PLACE, "pause": SECONDS, "first_pause": SECONDS, "pause_ball": SHARE,
    },
    "ResetConfig": {
        "base_x": PLACE, "base_y": PLACE, "yaw": ANGLE, "linear_velocity": PLACE, "roll_pitch_rate": PLACE,
        "yaw_rate": PLACE, "joint_scale": PLACE, "right_arm_offset": ADDED, "min_base_height": ADDED,
        "bounds_x": (-1000.0, 1000.0), "bounds_y": (-1000.0, 1000.0),
    },
    "RewardConfig": {
        "scale": (0.0, 1e6), "target_x": PLACE, "arm_offset": PLACE, "idle_base_xy": PLACE, "idle_height": PLACE,
        "nothing_to_hit": PLACE,
    },
    "RewardTerm": {"weight": (-1e6, 1e6), "params": (-1e6, 1e6)},
    "ReturnMemoryConfig": {
        "prior": AMPLITUDE, "prior_hits": (TINY, 1e6), "hits": (1.0, 1e6), "reach": (TINY, 100.0),
        "closing_speed": (TINY, 100.0), "largest": (TINY, 100.0),
    },
    "RubberMemoryConfig": {
        "bounce_spin": (0.0, 1e4), "radius": (TINY, 1.0), "prior_grip": AMPLITUDE, "slip": (TINY, 100.0),
        "largest_grip": (TINY, 100.0),
    },
    "DelayEstimateConfig": {"prior": SECONDS, "prior_worth": (TINY, 1e6), "smoothing": SHARE, "fading": SHARE},
    "AttitudeEstimateConfig": {"gain": SHARE},
    "JointEstimateConfig": {
        "acceleration": (TINY, 1e6), "position_noise": (TINY, 100.0), "velocity_noise": (TINY, 1000.0)
    },
    "ObservationConfig": {"policy_history": (1, 1000), "critic_history": (1, 1000)},
    "Prior": {"mean": (-1e6, 1e6), "std": (TINY, 1e6)},
    "FlightFit": {
        "noise": (TINY, 1.0), "contact_height": (0.0, 100.0), "low": (0.0, 100.0), "after_bounce": SECONDS,
        "least_gravity": (TINY, 1000.0), "launch_width": (TINY, 1e6), "bounce_width": (TINY, 1e6),
        "rebound_width": (TINY, 1e6), "restitution": SHARE, "friction": COEFFICIENT,
    },
    "PredictorConfig": {
        "frames": (1, 1000), "hidden": SIZE, "learning_rate": (TINY, 10.0), "batch_size": (1, 10**7),
        "batches_per_update": (1, 10**6), "train_updates": (0, 10**9),
    },
    "TaskConfig": {"landing_target": PLACE},
    "Begin": {"samples": SAMPLES, "share": SHARE},
    "SchedulePoint": {"value": (0.0, 1e6)},
    "AlgoConfig": {
        "steps": (1, 10_000), "epochs": (1, 1000), "minibatches": (1, 10**6), "actor_hidden": SIZE,
        "critic_hidden": SIZE, "gamma": SHARE, "gae_lambda": SHARE, "clip": (TINY, 1e6),
        "value_coefficient": (0.0, 1e6), "std_floor": AMPLITUDE, "learning_rate": (0.0, 10.0),
        "learning_rate_min": (0.0, 10.0), "learning_rate_max": (0.0, 10.0), "max_grad_norm": (TINY, 1e9),
        "observation_clip": (TINY, 1e9), "last_layer_gain": FACTOR, "fp32_below": AMPLITUDE, "params": ANY,
        "skips": (0, 10**6),
    },
    "JudgeConfig": {
        "serves": (0, 10**7), "worlds": (1, 10**6), "last_serves": (0, 10**7), "last_worlds": (1, 10**6),
        "warmup_serves": (0, 1000), "physics_dt": STEP, "after": (0.0, 1e6), "video": (0.0, 1e5),
    },
    "PlanConfig": {
        "warm_up": (0, 10**6), "updates": COUNT, "seconds": SECONDS, "samples": (1.0, 1e15),
    },
    "DeviceValues": {
        "num_worlds": (1, 2**24), "steps": (1, 10_000), "minibatches": (1, 10**6), "memory": (0.0, 1e6),
        "memory_per_world": (0.0, 1e3), "samples": (1.0, 1e15), "minutes": MINUTES,
    },
    "TrainConfig": {
        "num_worlds": (1, 2**24), "processes": (0, 4096), "seed": SEED,
        "samples": (1.0, math.inf),  # inf: until minutes, or a signal
        "minutes": MINUTES, "checkpoint_minutes": MINUTES,
    },
    "BenchOptions": {
        "repeats": (1, 10**6), "settle_steps": COUNT, "control_steps": COUNT, "mjwarp_steps": COUNT,
        "action_std": (0.0, 1e6), "update_worlds": (1, 2**24), "policy_size": SIZE, "critic_size": SIZE,
        "action_size": SIZE, "train_updates": COUNT, "memory_updates": COUNT,
    },
    "PaperRow": {"serves": COUNT, "hit": SHARE, "success": SHARE},
    "VariationConfig": {
        "noise": (0.0, 1000.0), "latency": SECONDS, "friction": ADDED, "trunk_mass": (-1000.0, 1000.0), "gain": FACTOR
    },
    "QualityConfig": {
        "range_end": SHARE, "torque_slack": SHARE, "calm_speed": AMPLITUDE, "after_hit": SECONDS,
        "sway_window": SECONDS, "edge": FACTOR, "poses": COUNT,
    },
    "EvaluateConfig": {
        "serves": COUNT, "warmup_serves": (0, 10**6), "balls_per_world": COUNT, "num_worlds": (1, 2**24), "seed": SEED,
        "physics_dt": STEP, "sweep_serves": COUNT, "sweep_serves_slow": COUNT, "first_ball": SECONDS,
        "first_ball_worlds": (1, 2**24),
    },
    "ExportConfig": {
        "check_worlds": (1, 2**20), "check_steps": (1, 10**6), "tolerance": (TINY, 1e3), "seed": SEED
    },
    "PageConfig": {"port": (1, 65_535), "speed": (1e-3, 1.0), "seed": SEED, "physics_dt": STEP},
    "PlayConfig": {"seconds": (TINY, 1e6), "width": (2, 16_384), "height": (2, 16_384), "fps": (1, 1000)},
    "RetraceConfig": {"tolerance": (TINY, 1e3), "late": (TINY, 1e3)},
    "AblateConfig": {"seeds": SEED, "samples": (1.0, 1e15), "jobs": (1, 4096), "window": (TINY, 1e15)},
    "CompareConfig": {
        "window": (TINY, 1e15), "serves": COUNT, "warmup_serves": (0, 10**6), "balls_per_world": COUNT,
        "num_worlds": (1, 2**24), "seed": SEED, "physics_dt": STEP,
    },
    "StudiesConfig": {"worlds": (1, 2**24), "serves": COUNT, "hours": (TINY, 1000.0)},
}  # fmt: skip


def limits_of(owner: type, key: str) -> Limits | None:
    """Least and largest value of a key of a class, or of a class that it extends; None: a key without a range."""
    for cls in owner.__mro__:
        if key in LIMITS.get(cls.__name__, {}):
            return LIMITS[cls.__name__][key]
    return None


def first_outside(config: Any, name: str = "") -> str | None:
    """What is wrong with the first number of a configuration that is out of its range; None if none is."""
    return next(_outside(config, name), None)


def _outside(config: Any, name: str) -> Iterator[str]:
    for field in fields(config):
        key, value = f"{name}{field.name}", getattr(config, field.name)
        for place, item in _items(key, value):
            if is_dataclass(item):
                yield from _outside(item, f"{place}.")
            elif isinstance(item, int | float) and not isinstance(item, bool):
                limits = limits_of(type(config), field.name)
                if limits is not None and not limits[0] <= item <= limits[1]:  # NaN is not
                    yield f"{place} must {_text(*limits)}, got {item}"


def _items(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The value of a key, or the members of a list or a table at any depth, with their places."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _items(f"{key}.{name}", item)
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _items(f"{key}[{index}]", item)
    else:
        yield key, value


def _text(low: float, high: float) -> str:
    if high == math.inf:
        return f"be at least {low:g}"
    least, most = (str(limit) if isinstance(limit, int) else f"{limit:g}" for limit in (low, high))
    return f"be above 0 and at most {most}" if low == TINY else f"lie within {least} and {most}"
