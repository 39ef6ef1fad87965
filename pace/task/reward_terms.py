"""The table of reward terms: small pure functions ``(state, params) -> Tensor (N,)`` by name.

A term may come from outside of the package (:mod:`pace.config.plugins`), which imports :mod:`pace.task.rewards`:
``+reward.terms.mine={weight: 1.0, function: my_module:my_term}``, or an entry point.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, cast

import torch
from torch import Tensor

from pace.config.plugins import REWARD_TERMS, Registry
from pace.task.state import TaskState

Params = Mapping[str, float]
Term = Callable[[TaskState, Params], Tensor]


class RewardFunction(NamedTuple):
    """A term and the names of the parameters that it needs; ``None``: whichever the configuration gives it."""

    function: Term
    params: tuple[str, ...] | None


def _accept(found: object) -> RewardFunction:
    """What an import path or an entry point named: a function of :data:`TERMS`, any other, or a RewardFunction."""
    if isinstance(found, RewardFunction):
        return found
    if not callable(found):
        raise TypeError("a reward term is a function of (state, params)")
    entered = (entry for entry in TERMS.values() if entry.function is found)
    return next(entered, RewardFunction(cast(Term, found), None))


#: All terms by name.
TERMS: Registry[RewardFunction] = Registry("reward term", REWARD_TERMS, _accept, where="reward.terms.")


def term(*params: str) -> Callable[[Term], Term]:
    """Enter a function into :data:`TERMS` under its own name, which must be free."""

    def enter(function: Term) -> Term:
        TERMS.enter(function.__name__, RewardFunction(function, params))
        return function

    return enter


def length(vector: Tensor) -> Tensor:
    """Norm (N, ...) of ``vector`` (N, ..., 3)."""
    return torch.linalg.vector_norm(vector, dim=-1)


def kernel(error: Tensor, params: Params) -> Tensor:
    """exp(-max(error, tolerance) / sigma^2): flat near the goal."""
    return error.clamp(min=params["tolerance"]).mul_(-1.0 / params["sigma"] ** 2).exp_()
