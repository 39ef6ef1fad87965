"""The reward of an environment: the sum of its weighted terms, small pure functions ``(state, params) -> Tensor (N,)``.

Weights and parameters live in ``configs/reward/``. :class:`RewardManager` checks names, parameters and shapes, and sums
``scale * weight * control_dt * value``; that holds for one-off terms too. Who imports :func:`term` from here finds the
names of the package's terms taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pace.arrays.state import Stateful
from pace.config.base import ConfigError
from pace.config.limits import TINY
from pace.config.task import RewardConfig, RewardTerm
from pace.task import ball_rewards, body_rewards  # noqa: F401  they enter the terms of the package into TERMS
from pace.task.reward_terms import TERMS, RewardFunction, Term, term
from pace.task.state import TaskState

__all__ = ["TERMS", "RewardFunction", "RewardManager", "find_term", "term"]


DIVISORS = ("sigma", "time", "reach")  # parameters by which terms of the package divide


@dataclass
class _Entry:
    name: str
    function: Term
    params: dict[str, float]


class RewardManager(Stateful):
    """Computes the reward of N worlds and keeps each term's sum. Without a term the reward is 0.

    Attributes: ``names`` of the T terms, ``values`` (T, N) unweighted, ``reward`` (N,) as the learner sees it,
    ``sums`` (T,) of the weighted terms over worlds and steps since the last :meth:`pop_sums`.

    Errors: :class:`ConfigError` for an unknown term, or a missing or unknown parameter.
    """

    STATE = ("_weights", "values", "reward", "sums")

    def __init__(self, config: RewardConfig, num_worlds: int, device: torch.device, control_dt: float) -> None:
        found = {name: find_term(name, entry) for name, entry in config.terms.items()}
        self._entries = [_Entry(name, function, config.terms[name].params) for name, function in found.items()]
        self.names = tuple(config.terms)
        weights = [entry.weight * control_dt * config.scale for entry in config.terms.values()]
        self._weights = torch.tensor(weights, dtype=torch.float32, device=device)
        self.values = torch.zeros(len(weights), num_worlds, device=device)
        self.reward = torch.zeros(num_worlds, device=device)
        self.sums = torch.zeros(len(weights), device=device)

    def compute(self, state: TaskState) -> None:
        """Evaluate all terms on ``state``. Errors: ``ValueError`` that names a term whose shape is not (N,)."""
        values = [entry.function(state, entry.params) for entry in self._entries]
        for entry, value in zip(self._entries, values, strict=True):
            if value.shape != self.reward.shape:
                wanted = tuple(self.reward.shape)
                raise ValueError(f"reward term '{entry.name}' has shape {tuple(value.shape)}, not {wanted}")
        if not values:
            return
        torch.stack(values, out=self.values)
        torch.mv(self.values.T, self._weights, out=self.reward)
        self.sums.addcmul_(self.values.sum(1), self._weights)

    @property
    def weighted(self) -> Tensor:
        """(T, N): what each term adds to the reward."""
        return self.values * self._weights.unsqueeze(1)

    def pop_sums(self) -> dict[str, Tensor]:
        """Sums of the weighted terms (0-d) since the last call; they add up to the sum of the rewards."""
        popped = dict(zip(self.names, self.sums.clone().unbind(), strict=True))
        self.sums.zero_()
        return popped


def find_term(name: str, entry: RewardTerm) -> Term:
    """Function of the term that the configuration calls ``name``: ``entry.function``, or the one of that name.

    Errors: :class:`ConfigError` for an unknown one, and unless ``entry.params`` are exactly its parameters.
    """
    try:
        function, needed = TERMS[entry.function or name]
    except ConfigError as error:
        raise ConfigError(f"reward.terms.{name}.function: {error}" if entry.function else str(error)) from error
    params = entry.params
    if needed is not None and set(needed) != set(params):
        missing, unknown = set(needed) - set(params), set(params) - set(needed)
        what = f"misses {sorted(missing)}" if missing else f"does not know {sorted(unknown)}"
        raise ConfigError(f"reward.terms.{name}.params {what}; it needs {list(needed)}")
    for key in ("sigma",) if needed is None else DIVISORS:
        if not params.get(key, 1.0) >= TINY:
            raise ConfigError(f"reward.terms.{name}.params.{key} must be positive, got {params[key]}")
    return function
