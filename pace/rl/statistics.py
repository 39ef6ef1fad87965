"""Counts of what happened in N worlds, summed on the device until somebody asks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pace.rl.task import Outcome

if TYPE_CHECKING:
    from pace.rl.env import TableTennisEnv

#: Outcomes that serves are counted by; ``outcome/success`` and the others add up to ``serves``.
COUNTED = tuple(outcome for outcome in Outcome if outcome not in (Outcome.OPEN, Outcome.BAD_SERVE))
NAMES = (
    "serves",
    "hits",
    "rim_hits",
    "successes",
    "bad_serves",
    "falls",
    "episodes",
    "steps",
    *(f"outcome/{outcome.name.lower()}" for outcome in COUNTED),
)


class Statistics:
    """Sums over worlds and control steps since the last :meth:`pop`.

    ``serves`` that ended, without ``bad_serves``; ``hits``, ``rim_hits`` and ``successes`` among them; their
    ``outcome/<name>``; ``falls`` (or area left), ``episodes`` that ended, ``steps`` of all worlds. Serves are counted
    at their end, and not while a world plays its first ``env.warmup_serves``.
    """

    def __init__(self, num_worlds: int, device: torch.device) -> None:
        self.sums = torch.zeros(len(NAMES), device=device)
        self._codes = torch.tensor([int(outcome) for outcome in COUNTED], device=device).unsqueeze(-1)
        self._one_step = torch.ones(num_worlds, dtype=torch.bool, device=device)

    def add(self, env: TableTennisEnv) -> None:
        """Count the step that ``env`` just made."""
        referee = env.game.referee
        ended = env.serve_over & (env.game.clock.played >= env.first_counted_serve)
        bad = env.serve_outcome == Outcome.BAD_SERVE
        counted = ended & ~bad
        hit = counted & referee.hit
        success = counted & (env.serve_outcome == Outcome.SUCCESS)
        done = env.terminated | env.truncated
        flags = (counted, hit, hit & referee.rim, success, ended & bad, env.terminated, done, self._one_step)
        outcomes = (env.serve_outcome == self._codes) & counted
        self.sums += torch.cat((torch.stack(flags), outcomes)).sum(1)

    def pop(self) -> dict[str, Tensor]:
        """The sums by name, as 0-d tensors; starts anew."""
        popped = dict(zip(NAMES, self.sums.clone().unbind(), strict=True))
        self.sums.zero_()
        return popped
