"""Upgrades of saved configurations and states from older versions of pace.

A checkpoint holds the number of its format. When keys, choices or the saved state change, add a function to
:data:`CONFIG_UPGRADES` or :data:`STATE_UPGRADES` with the format that it makes, and raise :data:`FORMAT` to that number
unless it was raised already since the last release. Functions change their argument in place, and run in order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from typing import Any

from pace.config.base import to_dict
from pace.config.predictor import PredictorPriors
from pace.config.renamed import change_stages, with_current_names
from pace.config.task import SPINS

#: Format that this version writes. 1: version 0.1.0 up to commit 43400ac; 2: up to 72b96bb, before the true world;
#: 3: up to 8d3869a, before gears had play and motors the maker's numbers; 4: up to cd18fd6, before the free hand on the
#: table had its own outcome; 5: up to 027ac53, before the frame with the base had an age and a good serve was repeated.
FORMAT = 6

#: Landing target of a saved configuration without one (released configuration).
LANDING_TARGET = (1.15, 0.0)  # m

#: Parameters of the ball that are sampled since format 3.
NEW_BALL_SAMPLES = (
    "table_drag",
    "table_lift",
    "table_tangential_restitution",
    "paddle_tangential_restitution",
    "paddle_drilling_loss",
)

#: Parameters of the robot that are sampled since format 4, and the value that changes nothing.
NEW_ROBOT_SAMPLES = {"speed_scale": 1.0, "ankle_effort_scale": 1.0, "joint_friction": 0.0, "joint_damping": 0.0}

#: Hands of the robots of this package, by their MJCF; new keys of the robot in format 4.
HANDS: dict[str, dict[str, Any]] = {
    "t1_paddle.xml": {"paddle_hand": [], "free_hand": "left_hand_link"},
    "t1_29dof_paddle.xml": {"paddle_hand": ["right_hand_link"], "free_hand": "AL4"},
}

Saved = dict[str, Any]
Upgrade = tuple[int, Callable[[Saved], None]]


def name_the_folder_out(config: Saved) -> None:
    """``run_dir``, the folder that a run writes, is ``out``."""
    if "run_dir" in config:
        config["out"] = config.pop("run_dir")


def rename_choices(config: Saved) -> None:
    """Choices, in each group's ``name`` and in the stages of the curriculum, have their current names."""
    config |= with_current_names(config)


def name_the_robots_parts(config: Saved) -> None:
    """The MJCF and the names of the robot's parts, once constants of the code: those of the T1 with its paddle."""
    robot = config.get("robot")
    if not isinstance(robot, dict):
        return
    robot.update(
        model="t1_paddle.xml",
        paddle_site="paddle",
        foot_sites=["left_foot", "right_foot"],
        head_site="head",
        arm=["Right_Shoulder", "Right_Elbow"],
        groups={
            "ankles": ["Ankle"],
            "hip_waist_left_arm": ["Left_Shoulder_Pitch", "Left_Elbow", "Hip_Roll", "Hip_Yaw", "Waist"],
            "left_shoulder_roll": ["Left_Shoulder_Roll"],
            "right_arm": ["Right_Shoulder", "Right_Elbow"],
        },
    )


def move_the_landing_target(config: Saved) -> None:
    """``landing_target`` of the task was x and y of the reward term ``predicted_landing``."""
    params = _entry(config, "reward", "terms", "predicted_landing", "params")
    place = [params.pop(axis, known) for axis, known in zip("xy", LANDING_TARGET, strict=True)]
    config.setdefault("landing_target", place)


def store_the_predictors_priors(config: Saved) -> None:
    """``predictor.priors`` were constants of the code."""
    predictor = _entry(config, "predictor")
    if predictor and predictor.get("priors") is None:
        predictor["priors"] = to_dict(PredictorPriors())


def name_the_first_reading(config: Saved) -> None:
    """Presets whose rubber was read wrongly, and has no tangential restitution, are not those of the same name now."""
    ball = _entry(config, "ball")
    if ball.get("name") in ("rubber", "standard", "venue") and "paddle_tangential_restitution" not in ball:
        ball["name"] += "_first_reading"


def add_what_rubber_and_air_sample(state: Saved) -> None:
    """A world's samples of ``ball`` that did not exist: no tangential restitution, constant coefficients of the air."""
    for env in _environments(state):
        rows = env["worlds.drawn.ball.mass"]
        for name in NEW_BALL_SAMPLES:
            env.setdefault(f"worlds.drawn.ball.{name}", rows.new_zeros(rows.shape))


def split_the_spin(config: Saved) -> None:
    """``serve.spin`` was one range for three axes, in the serve and in the stages of the curriculum."""
    serve = _entry(config, "serve")
    if "spin" in serve:
        spin = serve.pop("spin")
        serve.update({axis: list(spin) for axis in SPINS})
    change_stages(config, _split_spin)


def _split_spin(override: str) -> list[str]:
    """``serve.spin=RANGE`` as an override of each axis; others unchanged."""
    key, equals, spin = override.partition("=")
    return [f"serve.{axis}={spin}" for axis in SPINS] if equals and key.strip() == "serve.spin" else [override]


def add_the_pauses(state: Saved) -> None:
    """Without pauses no world waits, every ball is in view, and the next serve is sampled as the last one ends."""
    for env in _environments(state):
        over, position = env["game.ends.over"], env["worlds.position"]
        env.setdefault("worlds.in_view", over.new_ones(over.shape))
        env.setdefault("game.pause.waiting", over.new_zeros(over.shape))
        env.setdefault("game.pause.left", position.new_zeros(over.shape))
        env.setdefault("game.pause.carried", position.new_zeros(position.shape))
        env.setdefault("game.pause.kind", env["game.ends.outcome"].new_zeros(over.shape))
        env.setdefault("serves.sampled", position.new_zeros(len(position), 9))


def sample_play_and_mount(state: Saved) -> None:
    """A world's gears had no play, and its paddle was where the model has it."""
    for env in _environments(state):
        position = env["worlds.position"]
        env.setdefault("worlds.drawn.backlash", position.new_zeros(len(position)))
        env.setdefault("worlds.drawn.paddle_error", position.new_zeros(len(position), 5))


def count_seeds_from_zero(config: Saved) -> None:
    """A seed is at least 0 and below 2^32; which numbers it gives to new worlds is of no meaning."""
    if isinstance(config.get("seed"), int):
        config["seed"] %= 2**32


def describe_the_frames(state: Saved) -> None:
    """The sensors' delay line gets columns: 1 in a new ball's first frame, of which it held none with an older ball,
    and 1 with the ball in view, as it always was; the sensed ball has an age (saved tasks had steps of 0.02 s).
    """
    for env in _environments(state):
        line, over = env["sensing._line"], env["game.ends.over"]
        known = line.shape[-1]
        wider = line.new_zeros(*line.shape[:-1], known + 2)
        wider[..., :known] = line
        wider[..., -1] = 1.0
        env["sensing._line"] = wider
        env["sensing.ball_age"] = env["track.age"] = 0.02 * env["sensing._delay"]
        env["sensing.ball_new"] = over.new_ones(over.shape)
        env["env.predictor_valid"] = env["game.target.something_to_hit"] & env["track.something_to_hit"]


def add_what_motors_and_joints_sample(state: Saved) -> None:
    """A world's samples of ``engine`` that did not exist."""
    for env in _environments(state):
        rows = env["worlds.drawn.engine.effort_scale"]
        for name, value in NEW_ROBOT_SAMPLES.items():
            env.setdefault(f"worlds.drawn.engine.{name}", rows.new_full(rows.shape, value))


def name_the_papers_robot(config: Saved) -> None:
    """``t1`` was what ``t1_paper`` is now, in the robot and in the stages of the curriculum."""
    robot = _entry(config, "robot")
    if robot.get("name") == "t1":
        robot["name"] = "t1_paper"
    change_stages(config, lambda text: ["robot=t1_paper" if text == "robot=t1" else text])


def name_the_hands(config: Saved) -> None:
    """The rule that the free hand must not touch the table holds for policies that were trained before it."""
    robot = _entry(config, "robot")
    for key, hand in HANDS.get(robot.get("model", ""), {}).items():
        robot.setdefault(key, hand)


def add_the_body(state: Saved) -> None:
    """The robot's body was no surface, and two outcomes were not counted: they are the last of the statistics."""
    for env in _environments(state):
        counts, sums = env["worlds.event.edge"], env["statistics.sums"]
        env.setdefault("worlds.event.body", counts.new_zeros(counts.shape))
        env.setdefault("worlds.event.body_time", env["worlds.event.edge_time"].new_full(counts.shape, float("inf")))
        env["statistics.sums"] = sums.new_zeros(len(sums) + 2)
        env["statistics.sums"][:-2] = sums


def count_the_free_hand(state: Saved) -> None:
    """The free hand on the table was counted with the pushes; its own count is the last of the statistics."""
    for env in _environments(state):
        sums = env["statistics.sums"]
        env["statistics.sums"] = sums.new_zeros(len(sums) + 1)
        env["statistics.sums"][:-1] = sums


def stamp_the_base(state: Saved) -> None:
    """The frame with the base has an age, as motion capture with frames of its own kept it for itself."""
    for env in _environments(state):
        over, delay = env["game.ends.over"], env["sensing._delay"]
        env["sensing.base_age"] = env.pop("sensing.mocap._base_age", 0.02 * delay)
        env["sensing.base_new"] = over.new_ones(over.shape)
        env["sensing._slow"] = delay.new_zeros(len(delay), 6)


def remember_a_good_serve(state: Saved) -> None:
    """A world repeats its last serve that landed well if it finds no other: so far, the last that it sampled."""
    for env in _environments(state):
        env["serves.good"] = env["serves.sampled"].clone()
        env["serves.good_about"] = env["serves.sampled"].new_zeros(len(env["serves.sampled"]), 3)


def _environments(state: Saved) -> Iterator[Saved]:
    """The saved tensors of each process's environment; none in a state without processes."""
    for process in state.get("processes") or ():
        yield process["env"]


def _entry(config: Any, *keys: str) -> Saved:
    """The dictionary under ``keys``; a new empty one if there is none."""
    for key in keys:
        config = config.get(key) if isinstance(config, dict) else None
    return config if isinstance(config, dict) else {}


#: (format that it makes, function of the configuration).
CONFIG_UPGRADES: list[Upgrade] = [
    (2, name_the_folder_out),
    (2, rename_choices),
    (2, name_the_robots_parts),
    (2, move_the_landing_target),
    (2, store_the_predictors_priors),
    (3, name_the_first_reading),
    (3, split_the_spin),
    (4, name_the_papers_robot),
    (4, name_the_hands),
    (4, count_seeds_from_zero),
]
#: (format that it makes, function of the training state: ``ppo``, ``regression`` and ``processes``, each of them with
#: ``env`` and ``random``). Tensors are in their places.
STATE_UPGRADES: list[Upgrade] = [
    (3, add_what_rubber_and_air_sample),
    (3, add_the_pauses),
    (3, describe_the_frames),
    (4, sample_play_and_mount),
    (4, add_what_motors_and_joints_sample),
    (4, add_the_body),
    (5, count_the_free_hand),
    (6, stamp_the_base),
    (6, remember_a_good_serve),
]


def upgrade_config(config: Saved, version: int) -> Saved:
    """A saved configuration of the format ``version``, in the current format; ``config`` is not changed."""
    changed = deepcopy(config)
    for _, upgrade in _due(version, CONFIG_UPGRADES):
        upgrade(changed)
    return changed


def upgrade_state(state: Saved, version: int) -> Saved:
    """The training state of a checkpoint of the format ``version``, in the current format, changed in place."""
    for _, upgrade in _due(version, STATE_UPGRADES):
        upgrade(state)
    return state


def _due(version: int, upgrades: Sequence[Upgrade]) -> list[Upgrade]:
    """Those that make a later format than ``version``, the earliest first."""
    return sorted((upgrade for upgrade in upgrades if upgrade[0] > version), key=lambda upgrade: upgrade[0])
