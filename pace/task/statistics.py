"""Counts of events in N worlds, summed on the device until they are read."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from pace.arrays.launch import Launch
from pace.arrays.state import Stateful
from pace.task.game import Game
from pace.task.game_state import GameArrays
from pace.task.outcome import Outcome

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

SERVES, HITS, RIM_HITS, SUCCESSES, BAD_SERVES, FALLS, EPISODES, STEPS = (wp.constant(i) for i in range(8))
#: Outcomes have their columns in the order of their codes, the first of which is 1, without that of a bad serve.
OUTCOMES = wp.constant(len(NAMES) - len(COUNTED) - 1)
SUCCESS, BAD_SERVE = wp.constant(int(Outcome.SUCCESS)), wp.constant(int(Outcome.BAD_SERVE))


@wp.kernel
def _count(game: GameArrays, first_counted: wp.array[wp.float32], sums: wp.array[wp.float32]):
    """Count one world's step. The sums are whole numbers, so the order in which worlds add to them does not matter."""
    world = wp.tid()
    if world == 0:
        wp.atomic_add(sums, STEPS, float(game.ends.over.shape[0]))
    if game.ends.lost[world]:
        wp.atomic_add(sums, FALLS, 1.0)
    if game.ends.lost[world] or game.ends.truncated[world]:
        wp.atomic_add(sums, EPISODES, 1.0)
    if not game.ends.over[world] or game.clock.played[world] < first_counted[0]:
        return
    outcome = game.ends.outcome[world]
    if outcome == BAD_SERVE:
        wp.atomic_add(sums, BAD_SERVES, 1.0)
        return
    wp.atomic_add(sums, SERVES, 1.0)
    wp.atomic_add(sums, OUTCOMES + wp.where(outcome > BAD_SERVE, outcome - 1, outcome), 1.0)
    if outcome == SUCCESS:
        wp.atomic_add(sums, SUCCESSES, 1.0)
    if game.referee.hit[world]:
        wp.atomic_add(sums, HITS, 1.0)
        if game.referee.rim[world]:
            wp.atomic_add(sums, RIM_HITS, 1.0)


class Statistics(Stateful):
    """Sums over worlds and control steps since the last :meth:`pop`.

    ``serves`` that ended, without ``bad_serves``; ``hits``, ``rim_hits`` and ``successes`` among them; their
    ``outcome/<name>``; ``falls`` (or area left), ``episodes`` that ended, ``steps`` of all worlds. Serves are counted
    at their end, and not while a world plays its first ``env.warmup_serves``.
    """

    STATE = ("sums",)

    def __init__(self, game: Game, first_counted: Tensor) -> None:
        """Of ``game``; a world's serves count from number ``first_counted`` (0-d) on."""
        played = game.clock.played
        self.sums = torch.zeros(len(NAMES), device=played.device)
        first = first_counted.view(1)
        self._count = Launch(_count, len(played), played.device, game=game, first_counted=first, sums=self.sums)

    def add(self) -> None:
        """Count the control step that was just judged, before the clock counts its serves."""
        self._count()

    def pop(self) -> dict[str, Tensor]:
        """The sums by name, as 0-d tensors; then set them to zero."""
        popped = dict(zip(NAMES, self.sums.clone().unbind(), strict=True))
        self.sums.zero_()
        return popped
