"""Wrong values in the configurations of the commands that use a policy: valid, or one line that names the key."""

from __future__ import annotations

import math
from typing import Any

import pytest
from omegaconf import OmegaConf

from pace.config import commands, page
from pace.config.base import ConfigError, compose, parse
from pace.config.limits import first_outside
from tests.helpers.examples import assert_one_line, check, counts_of, st, wrong_values
from tests.helpers.nested import changed, leaves, places, put

COMMANDS = {
    "evaluate": (commands.EvaluateConfig, ["run=any", "num_worlds=4"]),
    "play": (page.PlayConfig, ["run=any"]),
    "watch": (page.WatchConfig, ["run=any"]),
    "compare": (commands.CompareConfig, ["runs=[a,b]", "num_worlds=4"]),
    "export": (commands.ExportConfig, ["run=any"]),
    "retrace": (commands.RetraceConfig, ["policy=any", "log=any"]),
    "ablate": (commands.AblateConfig, []),
    "studies": (commands.StudiesConfig, []),
}


def plain(command: str) -> tuple[type, dict[str, Any]]:
    """The class of a command's configuration, and that configuration as it stands in configs/."""
    schema, needed = COMMANDS[command]
    given = OmegaConf.to_container(compose(command, needed))
    assert isinstance(given, dict)
    return schema, given  # type: ignore[return-value]


@counts_of(60, 200)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_with_wrong_values_is_valid_or_one_line(command: str, count: int) -> None:
    schema, given = plain(command)
    known, refused = sorted(places(given), key=str), []

    @check(count, st.lists(st.tuples(st.sampled_from(known), wrong_values()), min_size=1, max_size=3))
    def example(changes: list[tuple[tuple[Any, ...], Any]]) -> None:
        try:
            parsed = parse(changed(given, changes), schema)
        except ConfigError as error:
            assert_one_line(error)
            refused.append(error)
        else:
            assert first_outside(parsed) is None

    assert 0.2 * count < len(refused)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    "wrong",
    [math.nan, math.inf, -math.inf, -1e30, 1e30, pytest.param(10**400, id="huge"), -1, "many", None, [], {"a": 1}],
    ids=repr,
)
def test_each_number_of_a_command_that_means_nothing_is_one_line_with_its_key(command: str, wrong: Any) -> None:
    schema, given = plain(command)
    parse(given, schema)
    numbers = list(leaves(given))
    assert numbers
    for place in numbers:
        may_be_negative = any(key in place for key in ("friction", "trunk_mass"))
        if (wrong is None and place == ("num_worlds",)) or (wrong == -1 and may_be_negative):
            continue
        with pytest.raises(ConfigError) as error:
            parse(put(given, place, wrong), schema)
        assert_one_line(error.value)
        assert any(str(key) in str(error.value) for key in place), (place, str(error.value))


@pytest.mark.parametrize("command", COMMANDS)
def test_zero_is_refused_or_means_something(command: str) -> None:
    """Keys that may be 0: what it then means stands in their comments."""
    schema, given = plain(command)
    valid = set()
    for place in leaves(given):
        try:
            parse(put(given, place, 0), schema)
        except ConfigError as error:
            assert_one_line(error)
        else:
            valid.add(str(place[-1] if isinstance(place[-1], str) else place[-2]))
    assert valid == ZERO[command]


ZERO = {
    "evaluate": {
        "warmup_serves", "seed", "first_ball", "noise", "latency", "friction", "trunk_mass", "gain", "after_hit",
        "torque_slack", "hit", "success",
    },
    "play": {"seed"},
    "watch": {"seed"},
    "retrace": set(),
    "compare": {"seed", "warmup_serves"},
    "export": {"seed"},
    "ablate": {"seeds"},
    "studies": set(),
}  # fmt: skip
