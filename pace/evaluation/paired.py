"""Two policies on the same serves: ball k of world w is launched alike for both, and their outcomes are compared.

Both play the same task with the same seed, so robot, ball and delays of a world start alike too. What follows depends
on the policy: after a fall the world gets a new robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pace.config.overrides import override_task, without_reward
from pace.config.task import ServeConfig, TaskConfig
from pace.devices import resolve_device
from pace.evaluation.records import Z95, C, wilson
from pace.evaluation.serves import ENDLESS, OnCount, ServeRecorder, play
from pace.onboard.actor import Predictor
from pace.rl.policies import TaskPolicy
from pace.sim.ball.ball import BallSim
from pace.task.env import TableTennisEnv
from pace.task.game import Outcome
from pace.task.resets import ServeSampler

SPARE = 8  # listed serves of a world beyond those that count, for serves that miss the table; the list then repeats


class ListedServes(ServeSampler):
    """Serves from a list that the seed alone decides, whatever the robots do.

    Attributes: ``listed`` (K, N, 9), the launches of each world; ``number`` (N,), the next serve of each world, which
    the environment sets.
    """

    number: Tensor

    def __init__(self, config: ServeConfig, ball: BallSim, seed: int, count: int) -> None:
        super().__init__(config, ball, torch.Generator(ball.device).manual_seed(seed))
        self._worlds = torch.arange(ball.num_worlds, device=ball.device)
        everyone = torch.ones_like(self._worlds, dtype=torch.bool)
        launches = []
        for _ in range(count):
            super().sample(everyone)
            launches.append(self.sampled.clone())
        self.listed = torch.stack(launches)

    def sample(self, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`ServeSampler.sample`."""
        chosen = self.listed[self.number.long() % len(self.listed), self._worlds]
        self.sampled.copy_(torch.where(mask.unsqueeze(-1), chosen, self.sampled))
        return self.launch


class SameServesEnv(TableTennisEnv):
    """N worlds whose serves come from a list of ``count`` launches a world: those of ``seed``."""

    def __init__(
        self,
        config: TaskConfig,
        num_worlds: int,
        device: str | torch.device,
        seed: int,
        predictor: Predictor | None,
        count: int,
    ) -> None:
        self._listed_serves = count
        super().__init__(config, num_worlds, device, seed, predictor)

    def _make_serves(self) -> ListedServes:
        return ListedServes(self.config.serve, self.worlds.ball, self.generator.initial_seed(), self._listed_serves)

    def _build(self, predictor: Predictor | None) -> None:
        super()._build(predictor)
        assert isinstance(self._serves, ListedServes)
        self._serves.number = self.game.clock.played


def play_listed(
    policy: TaskPolicy,
    serve: str,
    serves: int,
    num_worlds: int,
    device: str = "auto",
    seed: int = 1,
    overrides: Sequence[str] = (),
    warmup_serves: int = 2,
    on_count: OnCount | None = None,
) -> Tensor:
    """Records (N, quota, columns of :data:`COLUMNS`) of at least ``serves`` listed serves of the range ``serve``.

    Arguments and errors as those of :func:`pace.evaluation.serves.evaluate_row`.
    """
    where, quota = resolve_device(device), math.ceil(serves / num_worlds)
    config = override_task(policy.config, ["reset=evaluation", f"serve={serve}", *overrides, *ENDLESS])
    policy.to(where)
    count = warmup_serves + quota + SPARE
    env = SameServesEnv(without_reward(config), num_worlds, where, seed, policy.predictor, count)
    recorder = ServeRecorder(env, warmup_serves, quota)
    play(env, policy, recorder, on_count)
    return recorder.records[:-1].cpu().view(num_worlds, quota, -1)


@dataclass(frozen=True)
class Paired:
    """Shares of two policies on the same serves, and their difference (second - first) with 95 % intervals.

    ``low`` and ``high`` take serves as independent; ``by_world`` is half of the interval that takes worlds as such.
    ``only`` counts the serves of which the first alone, and the second alone, was a hit (or a success); ``p_value`` is
    that of McNemar's exact test.
    """

    serves: int
    shares: tuple[float, float]
    difference: float
    low: float
    high: float
    by_world: float
    only: tuple[int, int]
    p_value: float


def compare_records(first: Tensor, second: Tensor) -> dict[str, Paired]:
    """``hit`` and ``success`` of two policies from their records (N, quota, columns), over the balls that both have."""
    same = first[:, :, None, C["ball"]] == second[:, None, :, C["ball"]]  # a serve that missed the table is left out
    world, one, other = same.nonzero(as_tuple=True)
    pairs = first[world, one], second[world, other]
    found = {}
    for name in ("hit", "success"):
        good = [rows[:, C["hit"]] > 0 if name == "hit" else rows[:, C["outcome"]] == Outcome.SUCCESS for rows in pairs]
        found[name] = compare_pairs(good[0], good[1], world)
    return found


def compare_pairs(first: Tensor, second: Tensor, world: Tensor) -> Paired:
    """``first`` and ``second`` (M,) bool, the same serves of two policies; ``world`` (M,) int of each."""
    total = len(first)
    both, neither = int((first & second).sum()), int((~first & ~second).sum())
    only = int((first & ~second).sum()), int((~first & second).sum())
    low, high = newcombe(both, *only, neither)
    shares = (float(first.double().mean()), float(second.double().mean()))
    by_world = _half_by_world(second.double() - first.double(), world)
    return Paired(total, shares, (only[1] - only[0]) / total, low, high, by_world, only, mcnemar(*only))


def _half_by_world(difference: Tensor, world: Tensor) -> float:
    """Half of the 95 % interval of the mean of ``difference`` (M,), from the sums of each world."""
    count = int(world.max()) + 1
    if count < 2:
        return math.nan
    residual = torch.zeros(count, dtype=torch.float64).index_add_(0, world, difference - difference.mean())
    return Z95 * math.sqrt(count / (count - 1) * float(residual.square().sum())) / len(difference)


def newcombe(both: int, first: int, second: int, neither: int) -> tuple[float, float]:
    """95 % interval of the difference (second - first) of two paired shares, from the counts of the four outcomes.

    R. G. Newcombe, Statistics in Medicine 17 (1998) 2635, method 10: Wilson's intervals of both shares, combined by
    their correlation with a continuity correction. NaN without a pair.
    """
    total = both + first + second + neither
    if total == 0:
        return math.nan, math.nan
    one, other = both + first, both + second
    margins = one * (total - one) * other * (total - other)
    product = both * neither - first * second
    corrected = max(product - total / 2, 0) if product > 0 else product
    phi = corrected / math.sqrt(margins) if margins else 0.0
    (low, high), (other_low, other_high) = wilson(one, total), wilson(other, total)
    share, other_share = one / total, other / total
    down = (other_share - other_low, high - share)
    up = (other_high - other_share, share - low)
    difference = other_share - share
    return difference - _combined(*down, phi), difference + _combined(*up, phi)


def _combined(one: float, other: float, phi: float) -> float:
    return math.sqrt(max(0.0, one * one - 2.0 * phi * one * other + other * other))


def mcnemar(first: int, second: int) -> float:
    """Two-sided p-value of McNemar's exact test: that ``first`` and ``second`` discordant pairs are a fair coin's."""
    total, least = first + second, min(first, second)
    if total == 0 or first == second:
        return 1.0
    logs = [
        math.lgamma(total + 1) - math.lgamma(k + 1) - math.lgamma(total - k + 1) - total * math.log(2.0)
        for k in range(least + 1)
    ]
    return min(1.0, 2.0 * math.fsum(math.exp(value) for value in logs))
