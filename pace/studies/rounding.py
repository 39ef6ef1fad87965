"""The KL divergence of a PPO update with bf16 networks: the share of the update and of rounding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pace.rl.agent import MLP, Policy
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.metrics import markdown
from pace.studies.common import ENDLESS

STEPS = 100  # control steps of each world
SEED = 6
MOVES = (1e-6, 1e-5, 3e-5, 1e-4)  # of every weight: one step of Adam at that learning rate
STDS = (0.5, 0.3, 0.2, 0.14, 0.09, 0.05)  # of the policy; algo.std falls from 1 to 0.1
FORMATS = (torch.bfloat16, torch.float32)


@dataclass(frozen=True)
class Rounding:
    """Squared shift of the mean action, summed over the joints, mean over the states: (moves, formats)."""

    policy: str
    shifts: Tensor

    def kl(self, std: float) -> Tensor:
        """KL divergence (moves, formats) between Gaussians of that standard deviation around the two means."""
        return 0.5 * self.shifts / std**2


def measure(run: Path, worlds: int) -> Rounding:
    """The policy of ``run`` in the states of its rollout, before and after its weights have moved."""
    policy = load_policy(run)
    network = policy.act
    assert isinstance(network, Policy)
    states = network.norm(_states(policy, worlds))
    return Rounding(run.name, torch.stack([shifts(network.mlp, states, move) for move in MOVES]))


@torch.no_grad()
def _states(policy: TaskPolicy, worlds: int) -> Tensor:
    """Observations (worlds, inputs) after ``STEPS`` control steps."""
    env = policy.make_env(worlds, "cpu", SEED, [*ENDLESS, "randomization=moderate"])
    for _ in range(STEPS):
        env.advance(policy(env.policy_observation))
    return env.policy_observation


@torch.no_grad()
def shifts(mlp: MLP, states: Tensor, move: float) -> Tensor:
    """(formats,): mean square of the shift of the mean action if every weight moves up or down by ``move``.

    ``states`` are normalised observations (n, inputs). The weights are restored afterwards.
    """
    own, before = mlp.dtype, [weight.clone() for weight in mlp.parameters()]
    still = _means(mlp, states)
    torch.manual_seed(SEED)
    for weight in mlp.parameters():
        weight.add_(torch.randn_like(weight).sign_(), alpha=move)
    moved = _means(mlp, states)
    for weight, value in zip(mlp.parameters(), before, strict=True):
        weight.copy_(value)
    mlp.dtype = own
    return torch.stack([(b - a).square().sum(-1).mean() for a, b in zip(still, moved, strict=True)])


def _means(mlp: MLP, states: Tensor) -> Sequence[Tensor]:
    found = []
    for mlp.dtype in FORMATS:
        found.append(mlp(states.to(mlp.dtype)))
    return found


def table(found: Rounding) -> str:
    """One row per standard deviation of the policy; bf16 / float32 for each move of the weights."""
    rows = [
        [f"{std:g}", *(" / ".join(f"{value:.2g}" for value in row) for row in found.kl(std).tolist())] for std in STDS
    ]
    return markdown(["std of the policy", *(f"weights moved by {move:g}" for move in MOVES)], rows)
