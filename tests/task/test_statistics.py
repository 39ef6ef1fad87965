"""The counts of a step, against the same counts in torch."""

from __future__ import annotations

import torch

from pace.task.outcome import Outcome
from pace.task.statistics import COUNTED, NAMES, Statistics
from tests.helpers.fakes import fake_game

WORLDS, STEPS, FIRST = 64, 40, 2


def expected(game, first: float) -> dict[str, float]:
    """One step's counts by name."""
    ends, referee = game.ends, game.referee
    over = ends.over & (game.clock.played >= first)
    bad = over & (ends.outcome == int(Outcome.BAD_SERVE))
    counted = over & ~bad
    hit = counted & referee.hit
    counts = {
        "serves": counted,
        "hits": hit,
        "rim_hits": hit & referee.rim,
        "successes": counted & (ends.outcome == int(Outcome.SUCCESS)),
        "bad_serves": bad,
        "falls": ends.lost,
        "episodes": ends.lost | ends.truncated,
        "steps": torch.ones_like(over),
    }
    counts |= {f"outcome/{o.name.lower()}": counted & (ends.outcome == int(o)) for o in COUNTED}
    return {name: float(flags.sum()) for name, flags in counts.items()}


def test_sums_are_those_of_the_flags_of_every_world_and_step() -> None:
    torch.manual_seed(4)
    game, _ = fake_game(WORLDS)
    first = torch.tensor(float(FIRST))
    statistics = Statistics(game, first)
    totals = dict.fromkeys(NAMES, 0.0)
    codes = torch.tensor([int(outcome) for outcome in (*COUNTED, Outcome.BAD_SERVE)], dtype=torch.int32)
    for _ in range(STEPS):
        for flags in (game.ends.over, game.ends.lost, game.ends.truncated, game.referee.hit, game.referee.rim):
            flags.copy_(torch.rand(WORLDS) < 0.5)
        game.ends.outcome.copy_(codes[torch.randint(len(codes), (WORLDS,))])
        game.clock.played.copy_(torch.randint(4, (WORLDS,)).float())
        statistics.add()
        for name, count in expected(game, FIRST).items():
            totals[name] += count
    popped = {name: float(value) for name, value in statistics.pop().items()}
    assert popped == totals
    assert min(totals.values()) > 0
    assert all(float(value) == 0 for value in statistics.pop().values())
