"""Worlds whose numbers go wrong: they are lost and reset; which they are, what went wrong, and their last steps."""

from __future__ import annotations

import torch

from pace.sim.replay import WorldReplay
from pace.sim.worlds import Worlds
from pace.task.game_state import GameState
from pace.task.history import History
from pace.task.outcome import Outcome
from pace.task.rewards import RewardManager

MOST_REPLAYS = 8  # worlds


class Faults:
    """The faults of N worlds.

    Attributes: ``bad`` (N,) bool, worlds in which a reward or an observation was not finite.

    Args: histories: of the observations, and the columns of each by name.
    """

    def __init__(
        self,
        worlds: Worlds,
        game: GameState,
        rewards: RewardManager,
        histories: tuple[tuple[History, dict[str, slice]], ...],
    ) -> None:
        self._worlds, self._game, self._rewards, self._histories = worlds, game, rewards, histories
        self.bad = torch.zeros_like(game.ends.lost)
        self._seen = 0  # control step of the last replays

    def lose_diverged(self) -> None:
        """After a control step was judged: worlds that have diverged are lost, as by a fall."""
        ends, diverged = self._game.ends, self._worlds.divergence.diverged
        ends.lost.logical_or_(diverged)
        ends.over.logical_or_(diverged & ~self._game.pause.waiting)
        for outcome in (self._game.referee.outcome, ends.outcome):
            outcome.masked_fill_(diverged & (outcome == int(Outcome.OPEN)), int(Outcome.FALL))
        going_on = diverged.logical_not()
        for flag in (ends.next_serve, ends.truncated):
            flag.logical_and_(going_on)

    def flag(self) -> None:
        """At the end of a control step: remember worlds whose reward or observation is not finite; they are lost."""
        total = self._rewards.reward.clone()
        for history, _ in self._histories:
            total += history.frame.sum(1)
        bad = total.isfinite().logical_not_()
        self.bad.logical_or_(bad)
        self._game.ends.lost.logical_or_(bad)

    def first(self) -> str | None:
        """World and term of a value that was not finite, or None. Waits for the device: ask once an update."""
        worlds = self.bad.nonzero()
        if worlds.numel() == 0:
            return None
        world = int(worlds[0])
        terms = self._rewards.values[:, world].isfinite().tolist()
        named = zip(self._rewards.names, terms, strict=True)
        bad = [f"reward term '{name}'" for name, finite in named if not finite]
        for history, columns in self._histories:
            finite = history.frames[world].isfinite().all(0)
            bad += [f"observation '{name}'" for name, where in columns.items() if not bool(finite[where].all())]
        # the fault of an earlier step may have gone from the last values
        return f"{bad[0] if bad else 'a reward or an observation'} of world {world} is not finite"

    def replays(self) -> list[WorldReplay]:
        """The last control steps of worlds that have diverged since the last call, or of ``bad`` ones, which are then
        forgotten: a few of them, if the worlds remember any (``engine.remembered_steps``). Waits for the device."""
        divergence, recorder = self._worlds.divergence, self._worlds.recorder
        now = int(divergence.step)
        when = torch.where(self.bad, now, divergence.when)
        worlds = (when > self._seen).nonzero().squeeze(1)[:MOST_REPLAYS].tolist()
        self._seen = now
        self.bad.zero_()
        if recorder is None:
            return []
        replays = [recorder.replay(world, int(when[world])) for world in worlds]
        return [replay for replay in replays if len(replay.qpos)]
