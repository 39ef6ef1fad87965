"""Schedules by control steps and by shares of the plan."""

from __future__ import annotations

import json

import pytest

from pace.config.base import ConfigError, parse, to_dict
from pace.config.overrides import stage_tasks
from pace.config.schedules import Position, SchedulePoint, position, position_of, scheduled
from pace.config.training import TrainConfig, load_train_config


def test_shares_are_values_of_the_place_in_the_plan() -> None:
    points = [
        SchedulePoint(share=0.0, value=1.0),
        SchedulePoint(share=0.5, value=0.6),
        SchedulePoint(share=1.0, value=0.2),
    ]
    at = [position(samples, 40e6) for samples in (0, 10e6, 20e6, 30e6, 40e6, 99e6)]
    assert [scheduled(points, place) for place in at] == pytest.approx([1.0, 0.8, 0.6, 0.4, 0.2, 0.2])
    assert scheduled(points, position(30e6, None)) == 1.0  # not planned yet


def test_the_recipe_is_the_same_by_shares_of_84_million_and_by_control_steps() -> None:
    std = load_train_config().algo.std
    in_samples = [SchedulePoint(84e6 * (point.share or 0.0), point.value) for point in std]
    for samples in (0.0, 3e6, 20e6, 63e6, 84e6):
        at = position(samples, 84e6)
        assert scheduled(std, at) == pytest.approx(scheduled(in_samples, at))
    assert [point.value for point in std] == [1.0, 0.75, 0.55, 0.42, 0.32, 0.24, 0.18, 0.12]


def test_stages_begin_at_shares() -> None:
    config = load_train_config(["curriculum=[{share: 0.3, task: ['sensing=wide']}]"])
    assert [len(stage_tasks(config, Position(1e9, share))) for share in (0.0, 0.29, 0.3, 1.0)] == [1, 1, 2, 2]
    assert len(stage_tasks(config)) == 2
    assert len(stage_tasks(config, position_of({"samples": 30.0, "planned": 100.0}))) == 2
    assert len(stage_tasks(config, position_of({"samples": 30.0}))) == 1


def test_later_steps_begin_at_a_share() -> None:
    algo = load_train_config(["algo.later_steps=[{share: 0.6, value: 12}]"]).algo
    assert [algo.steps_at(Position(1e9, share)) for share in (0.0, 0.59, 0.6, 2.0)] == [4, 4, 12, 12]


def test_schedules_survive_a_checkpoint_and_old_ones_have_no_shares() -> None:
    config = load_train_config(["algo.std=[{samples: 0, value: 0.5}]"])
    saved = json.loads(json.dumps(to_dict(config)))
    assert parse(saved, TrainConfig) == config
    saved["algo"]["std"] = [{"samples": 0, "value": 1.0}, {"samples": 2.5e6, "value": 0.75}]
    del saved["plan"]
    assert parse(saved, TrainConfig).algo.std[1] == SchedulePoint(2.5e6, 0.75)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("algo.std=[{samples: 0, value: 1}, {share: 0.5, value: 0.5}]", "algo.std: give samples or share, not both"),
        ("algo.entropy=[{samples: 0, share: 0, value: 1}]", "algo.entropy: give samples or share, not both"),
        ("algo.kl_target=[{value: 0.01}]", "algo.kl_target: each entry needs samples or share"),
        ("algo.std=[{share: 0}]", "value"),
        ("algo.std=[{share: 1.5, value: 1}]", r"algo.std\[0\].share must lie within 0 and 1, got 1.5"),
        ("curriculum=[{samples: 1, task: []}, {share: 0.5, task: []}]", "curriculum: give samples or share, not both"),
        ("curriculum=[{share: 0, task: []}]", "a stage at 0 is the task itself"),
        ("curriculum=[{share: 0.3, task: ['sensing=blind']}]", "from 30 % of the plan on"),
    ],
)
def test_a_wrong_schedule_is_told(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        stage_tasks(load_train_config([override]))


def test_one_limit_that_is_given_is_the_only_one() -> None:
    def limits(*overrides: str) -> tuple[float, float]:
        config = load_train_config(list(overrides))
        return config.samples, config.minutes

    inf = float("inf")
    assert limits() == (40e6, 30.0)
    assert limits("samples=5e6") == (5e6, 0.0)
    assert limits("minutes=5") == (inf, 5.0)
    assert limits("samples=5e6", "minutes=5") == (5e6, 5.0)
    assert limits("minutes=0") == (40e6, 0.0)
    assert limits("samples=inf") == (inf, 30.0)
    assert limits("samples=inf", "minutes=0") == (inf, 0.0)
