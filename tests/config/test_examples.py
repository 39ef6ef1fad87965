"""Wrong configurations and overrides, many of them: a valid configuration, or one line that names the key."""

from __future__ import annotations

import math
import sys
from typing import Any

import pytest

from pace.command.arguments import prepare
from pace.config.base import ConfigError, parse, to_dict
from pace.config.limits import first_outside
from pace.config.overrides import override_task
from pace.config.predictor import PredictorConfig
from pace.config.sim import BallConfig, EngineConfig, RandomizationConfig, RobotConfig, SensingConfig
from pace.config.task import ObservationConfig, ResetConfig, RewardConfig, ServeConfig
from pace.config.training import AlgoConfig, TrainConfig, load_train_config
from tests.helpers.examples import assert_one_line, check, counts, counts_of, st, wrong_values
from tests.helpers.nested import changed, places, put

PARTS = {
    "robot": RobotConfig, "ball": BallConfig, "engine": EngineConfig, "serve": ServeConfig, "sensing": SensingConfig,
    "randomization": RandomizationConfig, "reset": ResetConfig, "reward": RewardConfig, "algo": AlgoConfig,
    "observation": ObservationConfig, "predictor": PredictorConfig,
}  # fmt: skip
CONFIG = to_dict(load_train_config(["observation=memory", "sensing=mocap"]))


@counts_of(60)
@pytest.mark.parametrize("part", PARTS)
def test_a_part_with_wrong_values_is_valid_or_one_line(part: str, count: int) -> None:
    known = sorted(places(CONFIG[part]), key=str)

    @check(count, st.lists(st.tuples(st.sampled_from(known), wrong_values()), min_size=1, max_size=3))
    def example(changes: list[tuple[tuple[Any, ...], Any]]) -> None:
        try:
            parsed = parse(changed(CONFIG[part], changes), PARTS[part])
        except ConfigError as error:
            assert_one_line(error)
        else:
            assert first_outside(parsed) is None


RUN = [key for key, value in CONFIG.items() if not isinstance(value, dict)]


@counts
def test_keys_of_the_run_with_wrong_values_are_valid_or_one_line(count: int) -> None:
    small = {name: CONFIG[name] for name in CONFIG}

    @check(min(count, 150), st.sampled_from(RUN), wrong_values())
    def example(key: str, value: Any) -> None:
        try:
            parsed = parse(put(small, (key,), value), TrainConfig)
        except ConfigError as error:
            assert_one_line(error)
        else:
            assert 1 <= parsed.num_worlds <= 2**24
            assert not math.isnan(parsed.samples)


KEYS = ("seed", "num_worlds", "samples", "ball", "algo.gamma", "serve.vx", "reward.terms.success.weight", "curriculum")
PIECES = st.sampled_from(
    ["=", "+", "~", "--", "'", '"', "[", "]", "{", "}", ",", ":", "\\", "$", "${", " ", "nan", "1"]
)


def arguments() -> Any:
    key = st.one_of(st.sampled_from(KEYS), st.text(max_size=6))
    value = st.one_of(st.lists(PIECES, max_size=4).map("".join), st.text(max_size=8), wrong_values().map(str))
    return st.lists(st.one_of(st.tuples(key, value).map("=".join), value), max_size=3)


@counts_of(25)
def test_arguments_are_prepared_or_one_line(count: int) -> None:
    @check(10 * count, arguments())
    def example(given: list[str]) -> None:
        for command in ("train", "evaluate", "play", "studies"):
            try:
                prepared = prepare(command, given)
            except ConfigError as error:
                assert_one_line(error)
            else:
                assert all(isinstance(argument, str) for argument in prepared)


@counts
def test_a_command_ends_in_one_line_whatever_is_written(
    count: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from pace.command.run import run_command

    monkeypatch.setattr("pace.command.run.resolve_name", lambda _: lambda config: parse(config, TrainConfig))

    @check(max(10, count // 5), arguments())
    def example(given: list[str]) -> None:
        given = [each for each in given if not each.startswith(("-", "hydra"))]  # options of Hydra print its own text
        monkeypatch.setattr(sys, "argv", ["train", *given])
        status = run_command("train")
        error = capsys.readouterr().err
        assert status in (0, 2)
        assert "Traceback" not in error
        assert len(error.splitlines()) == (status == 2), error


@counts
def test_changes_of_a_saved_task_are_valid_or_one_line(count: int) -> None:
    config = load_train_config()

    @check(max(10, count // 5), arguments())
    def example(given: list[str]) -> None:
        try:
            override_task(config, given)
        except ConfigError as error:
            assert_one_line(error)
