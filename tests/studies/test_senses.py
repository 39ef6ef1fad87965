"""What a robot knows of its sensors: errors against the truth of the simulation, and policies that are refused."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from pace.config.base import ConfigError
from pace.studies import senses
from tests.helpers.envs import make_env
from tests.helpers.estimates import estimated
from tests.helpers.saved import save_run


def test_errors_are_those_of_the_truth() -> None:
    env = make_env(32, "native", "cpu", overrides=["observation=memory", "sensing=clean", "engine.threads=1"])
    estimated(env, "delay", "delay").fill_(0.005)
    found = dict(zip(range(11), senses.errors(env), strict=True))
    assert found[0].mean() == pytest.approx(1e3 * (0.017 + 0.005), rel=1e-4)  # without delay all of it is an error
    for column in range(1, 11):
        assert found[column].abs().max() < 0.05  # mrad, rad/s, mm
    env.sensing.joint_position += 0.01
    assert senses.errors(env)[5].norm(dim=1).mean() == pytest.approx(10.0, rel=1e-3)  # of one joint
    env.sensing.joint_position -= 0.01
    env.sensing.heading.copy_(env.worlds.robot.heading.flip(1) * torch.tensor([-1.0, 1.0]))  # a quarter turn
    assert senses.errors(env)[3].abs().mean() == pytest.approx(1e3 * math.pi / 2, rel=1e-4)
    env.sensing.heading.copy_(env.worlds.robot.heading)
    env.sensing.base_position[:, 0] += 0.01
    assert senses.errors(env)[9].norm(dim=1).mean() == pytest.approx(10.0, rel=1e-2)
    assert senses.errors(env)[10].abs().max() < 0.05


def test_a_policy_without_estimates_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="observation=memory"):
        senses.sense(save_run(tmp_path), 4)


def test_the_table_has_a_row_for_each_time() -> None:
    rows = senses.table(senses.Senses("made up", torch.arange(77.0).view(7, 11))).splitlines()
    assert rows[2].startswith("| 0.1 s | 0.00 | 1.00 | 2.0 |")
    assert rows[-1].endswith("| 75.0 | 76.0 |")
