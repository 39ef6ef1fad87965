"""Every number of the task anywhere in its range: worlds that play on finite numbers, or one line."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import fields, is_dataclass
from typing import Any

import torch

from pace.config.base import ConfigError, parse, to_dict
from pace.config.limits import limits_of
from pace.config.training import TrainConfig, load_train_config
from pace.task.env import TableTennisEnv
from tests.helpers.examples import assert_one_line, check, counts, st

PARTS = ("robot", "ball", "engine", "serve", "randomization", "sensing", "reset", "reward", "observation")
CONFIG = load_train_config(["observation=memory", "sensing=mocap", "engine=native", "engine.threads=1"])
Place = tuple[Any, ...]


def numbers(config: Any, place: Place = ()) -> Iterator[tuple[Place, tuple[float, float], bool]]:
    """Places of all numbers of a configuration, their limits, and whether they are whole."""
    for field in fields(config):
        yield from _numbers(getattr(config, field.name), (*place, field.name), limits_of(type(config), field.name))


def _numbers(value: Any, place: Place, limits: Any) -> Iterator[tuple[Place, tuple[float, float], bool]]:
    if is_dataclass(value):
        yield from numbers(value, place)
    elif isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _numbers(item, (*place, key), limits)
    elif isinstance(value, int | float) and not isinstance(value, bool) and limits is not None:
        yield place, limits, isinstance(value, int)


#: Sizes of memory: at their upper ends not even two worlds are small.
LARGEST = {"policy_history": 50, "critic_history": 50, "frames": 200, "attempts": 50, "remembered_steps": 200}
LARGEST |= {"solver_iterations": 100, "line_search_iterations": 100, "threads": 4}
ALL = sorted((n for part in PARTS for n in numbers(getattr(CONFIG, part), (part,))), key=str)


def changes() -> Any:
    """A place, and a value within its limits: their ends, close to them, or any other."""

    def values(found: tuple[Place, tuple[float, float], bool]) -> Any:
        place, (low, high), whole = found
        high = min(high, LARGEST.get(str(place[-1]), high))
        inside = st.integers(int(low), int(high)) if whole else st.floats(low, high)
        ends = [low, high] if whole or low > 0.0 else [low, high, 5e-324, 1e-40]  # no divisor, and none of float32
        return st.tuples(st.just(place), st.one_of(st.sampled_from(ends), inside))

    return st.sampled_from(ALL).flatmap(values)


def changed(place: Place, value: float) -> dict[str, Any]:
    """The configuration with one number changed; a range follows, so that its ends stay in order."""
    config = deepcopy(to_dict(CONFIG))
    inner: Any = config
    for key in place[:-1]:
        inner = inner[key]
    if isinstance(inner, list) and len(inner) == 2:
        other = 1 - place[-1]
        inner[other] = max(inner[other], value) if other else min(inner[other], value)
    inner[place[-1]] = value
    return config


@counts
def test_a_number_within_its_range_plays_or_is_one_line(count: int) -> None:
    @check(max(12, count // 3), changes())
    def example(change: tuple[Place, float]) -> None:
        try:
            env = TableTennisEnv(parse(changed(*change), TrainConfig), 2, "cpu", 1)
        except ConfigError as error:
            assert_one_line(error)
            return
        generator = torch.Generator().manual_seed(0)
        env.reset_worlds(torch.ones(2, dtype=torch.bool))
        for _ in range(4):
            env.advance(torch.randn(2, 21, generator=generator))
            env.reset_worlds(env.terminated | env.truncated)
            for seen in (env.policy_observation, env.critic_observation, env.reward):
                assert bool(seen.isfinite().all()), env.first_bad()
        assert all(bool(value.isfinite()) for value in env.pop_statistics().values())
