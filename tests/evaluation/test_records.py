"""Rates by the number of the ball, against counts by hand."""

from __future__ import annotations

import pytest
import torch

from pace.evaluation.figures import success_by_ball
from pace.evaluation.records import COLUMNS, C, by_ball, wilson
from pace.task.game import Outcome


def records(balls: list[tuple[int, bool, bool]]) -> torch.Tensor:
    """Serves by number of the ball, hit, success."""
    table = torch.zeros(len(balls), len(COLUMNS))
    for row, (number, hit, success) in zip(table, balls, strict=True):
        row[C["ball"]], row[C["hit"]] = number, float(hit)
        row[C["outcome"]] = Outcome.SUCCESS if success else Outcome.MISS
    return table


def test_groups_of_balls_have_their_own_rates() -> None:
    balls = [(1, True, False), (1, False, False), (2, True, True), (5, True, True), (9, True, False), (31, True, True)]
    found = by_ball(records(balls))
    assert [(row["balls"], row["first"], row["last"], row["serves"]) for row in found] == [
        ("1", 1, 1, 2),
        ("2", 2, 2, 1),
        ("5 to 9", 5, 9, 2),
        ("20+", 31, 31, 1),
    ]
    assert [row["hit"] for row in found] == [0.5, 1.0, 1.0, 1.0]
    assert [row["success"] for row in found] == [0.0, 1.0, 0.5, 1.0]
    assert (found[2]["success_low"], found[2]["success_high"]) == wilson(1, 2)


def test_the_figure_has_a_point_for_each_ball() -> None:
    numbers, low, middle, high = success_by_ball(records([(1, True, False), (3, True, True), (3, True, False)]))
    assert (numbers, middle) == ([1, 3], [0.0, 50.0])
    assert (low[1], high[1]) == pytest.approx(tuple(100.0 * bound for bound in wilson(1, 2)))
