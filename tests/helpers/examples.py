"""Property-based tests: of light examples a thousand for each kind of input by default, of the others some; a thousand
for each test in the long suite. The same each time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

hypothesis = pytest.importorskip("hypothesis")
st = pytest.importorskip("hypothesis.strategies")


def counts_of(few: int, many: int = 1000) -> pytest.MarkDecorator:
    """Parameter of a test: how many examples, by default and in the long suite."""
    return pytest.mark.parametrize("count", [few, pytest.param(many, marks=pytest.mark.long)], ids=["few", "many"])


counts = counts_of(20)


def check(count: int, *strategies: Any) -> Callable[[Callable[..., None]], None]:
    """Decorator: call a function with ``count`` examples of the strategies, at once."""

    def run(function: Callable[..., None]) -> None:
        limits = hypothesis.settings(
            max_examples=count,
            deadline=None,
            database=None,
            derandomize=True,
            suppress_health_check=list(hypothesis.HealthCheck),
        )
        limits(hypothesis.given(*strategies)(function))()

    return run


def wrong_values() -> Any:
    """What may stand in place of a number: other numbers of every size, and other kinds of values."""
    sizes = st.sampled_from([0, -1, 1, 2**31, 2**63, -(2**70), 10**400, 1e-300, 1e300, -0.0])
    floats = st.floats(allow_nan=True, allow_infinity=True)
    others = st.sampled_from([None, True, "", "1", "many", "nan", "${seed}", "${", [], [1], [[]], {}, {"a": 1}])
    return st.one_of(sizes, floats, st.integers(), others)


def json_values() -> Any:
    """Any JSON."""
    leaves = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8))
    names = st.text(max_size=8)
    return st.recursive(leaves, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3))


def assert_one_line(error: BaseException) -> None:
    """An error that a command prints without a traceback: a line that says something."""
    text = str(error)
    assert text.strip()
    assert "\n" not in text
    assert len(text) < 2000


def any_vectors() -> Any:
    """Three numbers of float32: ordinary ones of a table's size, others of every size, and what is no number."""
    ends = [0.0, -0.0, 1e-40, 1e19, -1e30, 3e38, float("inf"), float("-inf"), float("nan")]
    each = st.one_of(st.sampled_from(ends), st.floats(-20.0, 20.0), st.floats(width=32))
    return st.lists(each, min_size=3, max_size=3)
