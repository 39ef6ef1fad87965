"""Choices that were renamed: the old ones are gone, the new ones are there, and saved configurations follow."""

from __future__ import annotations

import pytest

from pace.config.base import config_dir
from pace.config.names import RENAMED_CHOICES, choices
from pace.rl.policies import load_policy


@pytest.mark.parametrize(("old", "new"), RENAMED_CHOICES.items())
def test_the_old_choice_is_gone_and_the_new_one_is_there(old: str, new: str) -> None:
    assert not (config_dir() / f"{old.replace('=', '/')}.yaml").exists()
    assert (config_dir() / f"{new.replace('=', '/')}.yaml").is_file()


def test_no_choice_is_called_pace_or_full() -> None:
    assert not {file.stem for file in config_dir().glob("*/**/*.yaml")} & {"pace", "full"}


def test_choices_in_folders_are_listed() -> None:
    assert choices("experiment") == [
        "ablation/baseline",
        "ablation/no_hit_guidance",
        "ablation/no_predictor",
        "ablation/no_return_guidance",
        "ablation/paper_reward",
        "generalist",
        "paper",
    ]


def test_a_policy_that_was_saved_with_old_names_has_the_new_ones() -> None:
    config = load_policy("pretrained/pace").config
    named = {group: getattr(config, group).name for group in ("reward", "observation", "algo", "predictor")}
    assert named == {
        "reward": "intercept",
        "observation": "paddle_pose",
        "algo": "small_batch",
        "predictor": "last_five",
    }
    assert config.randomization.name == "moderate"
