"""Choices that were renamed: the old ones are gone, the new ones are there, and saved configurations follow."""

from __future__ import annotations

import pytest

from pace.config.base import config_dir
from pace.config.renamed import RENAMED_CHOICES, renamed_choice, with_current_names
from pace.rl.policies import load_policy

PAIRS = [(group, old, new) for group, names in RENAMED_CHOICES.items() for old, new in names.items()]


@pytest.mark.parametrize(("group", "old", "new"), PAIRS)
def test_the_old_choice_is_gone_and_the_new_one_is_there(group: str, old: str, new: str) -> None:
    folder = config_dir() / group
    assert not (folder / f"{old}.yaml").exists()
    assert (folder / f"{new}.yaml").is_file()
    assert renamed_choice(group, old) == new
    assert renamed_choice(group, new) == new


def test_no_choice_is_called_pace_or_full() -> None:
    choices = {file.stem for file in config_dir().glob("*/**/*.yaml")}
    assert not choices & {"pace", "full"}


def test_a_saved_configuration_gets_current_names() -> None:
    saved = {
        "name": "pace",
        "algo": {"name": "pace", "gamma": 0.9},
        "reward": {"name": "of my own"},
        "randomization": {"name": "full"},
        "ball": {"name": "paper"},
        "curriculum": [{"samples": 1e6, "task": ["randomization=full", "serve.vx=[-6.0,-5.0]", "sensing=wide"]}],
    }
    assert with_current_names(saved) == {
        "name": "pace",  # of the run
        "algo": {"name": "small_batch", "gamma": 0.9},
        "reward": {"name": "of my own"},
        "randomization": {"name": "moderate"},
        "ball": {"name": "paper"},
        "curriculum": [{"samples": 1e6, "task": ["randomization=moderate", "serve.vx=[-6.0,-5.0]", "sensing=wide"]}],
    }
    assert saved["algo"] == {"name": "pace", "gamma": 0.9}
    for odd in ({}, {"algo": 3, "curriculum": 7}, {"curriculum": [{"samples": 1e6}, None]}):
        assert with_current_names(odd) == odd


def test_a_policy_that_was_saved_with_old_names_has_the_new_ones() -> None:
    config = load_policy("pretrained/pace").config
    named = {group: getattr(config, group).name for group in ("reward", "observation", "algo", "predictor")}
    assert named == {
        "reward": "intercept", "observation": "paddle_pose", "algo": "small_batch", "predictor": "last_five"
    }  # fmt: skip
    assert config.randomization.name == "moderate"
