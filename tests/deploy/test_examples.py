"""What a robot may read, by made-up examples: the exported file gives targets in their range, or there is one error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pace.deploy.player import Controller
from tests.helpers.examples import assert_one_line, check, counts_of, st
from tests.helpers.saved import export_quickly, remembering_policy


@pytest.fixture(scope="module")
def controller(tmp_path_factory: pytest.TempPathFactory) -> Controller:
    """Of a policy that remembers its returns, and uses all that it estimates."""
    return Controller(export_quickly(remembering_policy(), tmp_path_factory.mktemp("robot")))


def ordinary(controller: Controller) -> dict[str, Any]:
    """Readings of a robot that stands and sees a ball."""
    frame: dict[str, Any] = {name: np.zeros(size) for name, size in controller.sizes.items()}
    frame["joint_position"] = np.array(controller.meta["nominal_pose"])
    frame["base_position"] = np.array([-1.8, 0.3, 0.66])
    frame["projected_gravity"], frame["heading"] = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0])
    frame["ball_position"], frame["ball_age"], frame["ball_new"] = np.array([1.0, 0.0, 1.0]), np.ones(1), np.ones(1)
    return frame


#: In place of a number of a reading; then in place of a whole reading.
NUMBERS = st.one_of(
    st.sampled_from([0.0, -0.0, 1.0, 1e-40, 1e19, -1e30, 3e38, float("inf"), float("-inf"), float("nan"), 1e300]),
    st.floats(-20.0, 20.0),
    st.floats(width=32),
)
WHOLE = st.one_of(
    st.none(),
    st.text(max_size=3),
    st.integers(),
    st.just(10**400),
    st.just(1j),
    st.lists(NUMBERS, max_size=30),
    st.lists(st.lists(NUMBERS, max_size=3), max_size=3),
    st.dictionaries(st.text(max_size=2), NUMBERS, max_size=2),
    st.sampled_from([np.zeros((1, 3)), np.array(["1", "2", "3"]), np.array([None]), np.zeros(3, dtype=complex)]),
)


def within_range(controller: Controller, target: Any) -> bool:
    reach = controller.meta["action_scale"] * controller.meta["action_clip"]
    return bool((np.abs(target - np.array(controller.meta["nominal_pose"])) <= reach + 1e-4).all())


@counts_of(500)
def test_numbers_of_any_size_give_targets_in_their_range_or_one_error(controller: Controller, count: int) -> None:
    names = sorted(ordinary(controller))
    refused: list[str] = []
    moved: list[int] = []

    @check(count, st.lists(st.tuples(st.sampled_from(names), st.integers(0, 26), NUMBERS), min_size=1, max_size=4))
    def readings(changes: list[tuple[str, int, float]]) -> None:
        frame = ordinary(controller)
        controller.restart()
        controller(frame)
        for name, index, value in changes:
            frame[name][index % len(frame[name])] = value
        before = controller._state.copy()
        try:
            target = controller(frame)
        except ValueError as error:
            assert_one_line(error)
            refused.append(str(error))
            assert np.array_equal(controller._state, before)
        else:
            assert within_range(controller, target)
            moved.append(1)
        assert within_range(controller, controller(ordinary(controller)))  # the next call goes on

    assert len(moved) > count // 10
    assert any("is not finite" in text for text in refused)


@counts_of(500)
def test_readings_of_any_kind_give_one_error(controller: Controller, count: int) -> None:
    names = [*sorted(ordinary(controller)), "speed", "state", ""]

    @check(count, st.dictionaries(st.sampled_from(names), WHOLE, min_size=1, max_size=3), st.booleans())
    def readings(changes: dict[str, Any], alone: bool) -> None:
        frame = changes if alone else ordinary(controller) | changes
        try:
            target = controller(frame)
        except ValueError as error:
            assert_one_line(error)
        else:
            assert within_range(controller, target)
        assert within_range(controller, controller(ordinary(controller)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ball_position": [0.0, np.nan, 1.0]}, "the reading ball_position is not finite"),
        ({"heading": [1.0, 0.0, 0.0]}, "the reading heading must be a vector of 2 numbers"),
        ({"heading": [1e300, 0.0]}, "the reading heading is not finite"),
        ({"joint_velocity": "fast"}, "the reading joint_velocity must be a vector of 21 numbers"),
        ({"speed": [1.0]}, "the reading speed is no input of the file"),
    ],
)
def test_what_is_wrong_is_named(controller: Controller, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        controller(ordinary(controller) | changes)
    with pytest.raises(ValueError, match="the reading ball_age is missing"):
        controller({name: value for name, value in ordinary(controller).items() if name != "ball_age"})
