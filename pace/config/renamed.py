"""Renamed choices of ``configs/``: old and current names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

ABLATIONS = ("no_predictor", "no_hit_guidance", "no_return_guidance", "paper_reward")

#: Group -> old choice -> current choice. ``pace`` meant "the default" in four groups, and ``full`` three things.
RENAMED_CHOICES: dict[str, dict[str, str]] = {
    "reward": {"pace": "intercept"},
    "randomization": {"full": "moderate"},
    "observation": {"pace": "paddle_pose"},
    "algo": {"pace": "small_batch"},
    "predictor": {"pace": "last_five"},
    "bench": {"full": "all"},
    "experiment": {
        "full": "ablation/baseline",
        **{name: f"ablation/{name}" for name in ABLATIONS},
    },
}


def renamed_choice(group: str, choice: str) -> str:
    """The current name of ``choice`` in ``group``; a choice that was not renamed keeps its name."""
    return RENAMED_CHOICES.get(group, {}).get(choice, choice)


def with_current_names(saved: Mapping[str, Any]) -> dict[str, Any]:
    """A saved training configuration whose choices have their current names, in a new dictionary.

    That concerns the ``name`` of each group, and the choices in the stages of its curriculum.
    """
    config = dict(saved)
    for group in RENAMED_CHOICES:
        part = config.get(group)
        if isinstance(part, Mapping) and isinstance(part.get("name"), str):
            config[group] = {**part, "name": renamed_choice(group, part["name"])}
    change_stages(config, lambda text: [current_override(text)])
    return config


def change_stages(config: dict[str, Any], change: Callable[[str], list[str]]) -> None:
    """Replace each override in the stages of a saved curriculum by those that ``change`` gives for it, in new stages.

    Anything else is unchanged, and the check against the dataclasses reports it.
    """

    def changed(stage: Any) -> Any:
        if not isinstance(stage, Mapping) or not isinstance(stage.get("task"), list):
            return stage
        given = ([text] if not isinstance(text, str) else change(text) for text in stage["task"])
        return {**stage, "task": [text for texts in given for text in texts]}

    if isinstance(config.get("curriculum"), list):
        config["curriculum"] = [changed(stage) for stage in config["curriculum"]]


def current_override(text: str) -> str:
    """An override such as ``randomization=full`` with the current name of its choice; others unchanged."""
    group, equals, choice = text.partition("=")
    return f"{group}={renamed_choice(group, choice)}" if equals else text
