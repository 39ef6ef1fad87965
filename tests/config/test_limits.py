"""Ranges of the numbers in the configuration: every number has one, and what is beyond it is one line with its key."""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_type_hints

import pytest

import pace.config
from pace.config import ball, predictor, sim, task, training
from pace.config.base import ConfigError, parse
from pace.config.limits import LIMITS, first_outside, limits_of
from pace.config.training import TrainConfig, load_train_config
from pace.config.upgrade import upgrade_config
from tests.helpers.nested import leaves
from tests.helpers.recipes import defaults


def classes() -> list[type]:
    names = [module.name for module in pkgutil.iter_modules(pace.config.__path__, "pace.config.")]
    modules = [importlib.import_module(name) for name in names]
    found = {cls for module in modules for cls in vars(module).values() if isinstance(cls, type) and is_dataclass(cls)}
    return sorted(found, key=lambda cls: cls.__name__)


def numeric(hint: Any) -> bool:
    """Whether a key holds numbers: itself, or in a list or a table."""
    return hint in (int, float) or any(numeric(part) for part in get_args(hint))


def number_keys() -> Iterator[tuple[type, str]]:
    for cls in classes():
        hints = get_type_hints(cls)
        yield from ((cls, field.name) for field in fields(cls) if numeric(hints[field.name]))


def test_every_number_has_a_range() -> None:
    assert [f"{cls.__name__}.{key}" for cls, key in number_keys() if limits_of(cls, key) is None] == []
    known = {cls.__name__: {field.name for field in fields(cls)} for cls in classes()}
    unknown = [f"{name}.{key}" for name, table in LIMITS.items() for key in table if key not in known[name]]
    assert unknown == []


PARTS = {
    "robot": sim.RobotConfig, "ball": ball.BallConfig, "engine": sim.EngineConfig, "serve": task.ServeConfig,
    "randomization": sim.RandomizationConfig, "sensing": sim.SensingConfig, "reset": task.ResetConfig,
    "reward": task.RewardConfig, "observation": task.ObservationConfig, "algo": training.AlgoConfig,
    "predictor": predictor.PredictorConfig,
}  # fmt: skip


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf, -1e30, 1e30])
def test_a_number_that_means_nothing_is_one_line_with_its_key(part: str, wrong: float) -> None:
    """Each number of a part in turn. The part is read alone: its keys have no prefix."""
    given = deepcopy(defaults()[part])
    places = list(leaves(given))
    assert places
    for place in places:
        inner = given
        for key in place[:-1]:
            inner = inner[key]
        before = inner[place[-1]]
        inner[place[-1]] = int(wrong) if isinstance(before, int) and math.isfinite(wrong) else wrong
        with pytest.raises(ConfigError) as error:
            parse(given, PARTS[part])
        assert "\n" not in str(error.value)
        named = [str(key) for key in place if isinstance(key, str)]
        assert any(name in str(error.value) for name in named), (place, str(error.value))
        inner[place[-1]] = before
    parse(given, PARTS[part])


def test_a_range_is_told_in_words() -> None:
    config = load_train_config()
    config.num_worlds = 10**30
    assert first_outside(config) == f"num_worlds must lie within 1 and {2**24}, got {10**30}"
    config.num_worlds, config.samples = 8, 0.5
    assert first_outside(config) == "samples must be at least 1, got 0.5"
    config.samples, config.sensing.noise_scale[1] = math.inf, math.nan
    assert first_outside(config) == "sensing.noise_scale[1] must lie within 0 and 1000, got nan"
    config.sensing.noise_scale[1] = 1.0
    assert first_outside(config) is None


@pytest.mark.parametrize("seed", [-1, 2**32, -(2**70)])
def test_a_seed_is_counted_from_zero_and_an_old_one_is_kept(seed: int) -> None:
    with pytest.raises(ConfigError, match=f"seed must lie within 0 and 4294967295, got {seed}"):
        load_train_config([f"seed={seed}"])
    old = defaults() | {"seed": seed}
    assert parse(upgrade_config(old, 3), TrainConfig).seed == seed % 2**32


@pytest.mark.parametrize(
    "wrong",
    ["friction=[-5,-5]", "kp_scale=[-1,-1]", "kd_scale=[-1,-1]", "armature_scale=[-1,-1]", "effort_scale=[0,1]",
     "ball_mass_scale=[-1,-1]", "ball_mass_scale=[0,1]", "drag_scale=[-1,-1]", "lift_scale=[-1,0]",
     "push_interval=[-2,-1]", "paddle_tilt=[0,7]"],
)  # fmt: skip
def test_ranges_that_make_no_body_are_refused(wrong: str) -> None:
    with pytest.raises(ConfigError, match=rf"randomization\.{wrong.split('=')[0]}"):
        load_train_config([f"randomization.{wrong}"])
