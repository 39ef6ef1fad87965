"""PPO on one page, in the manner of CleanRL, on the gymnasium vector environment: a start for your own algorithm.

    pip install 'pace-table-tennis[interfaces]'
    python examples/ppo_gymnasium.py --worlds 256 --updates 200

The critic sees the truth (``critic``), the actor what the robot can know (``policy``).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

import pace
from pace.interfaces import GymnasiumEnv


@dataclass
class Settings:
    """Numbers of the algorithm."""

    worlds: int = 256
    updates: int = 200
    steps: int = 24  # control steps of a world per update
    epochs: int = 4
    minibatches: int = 4
    learning_rate: float = 3e-4
    gamma: float = 0.97
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 1e-3
    hidden: int = 256
    seed: int = 1


class Normaliser(nn.Module):
    """Running mean and variance of its inputs."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.mean, self.var, self.count = torch.zeros(size), torch.ones(size), 1e-4

    def update(self, batch: Tensor) -> None:
        """Take in a batch (N, size)."""
        total = self.count + len(batch)
        delta = batch.mean(0) - self.mean
        spread = self.var * self.count + batch.var(0, unbiased=False) * len(batch)
        self.var = (spread + delta.square() * self.count * len(batch) / total) / total
        self.mean, self.count = self.mean + delta * len(batch) / total, total

    def forward(self, values: Tensor) -> Tensor:
        """Normalised values."""
        return ((values - self.mean) / (self.var + 1e-8).sqrt()).clamp(-10.0, 10.0)


def network(sizes: list[int]) -> nn.Sequential:
    """An MLP with ELU."""
    layers = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.ELU())]
    return nn.Sequential(*layers[:-1])


class Agent(nn.Module):
    """Actor and critic, each with its own observation."""

    def __init__(self, policy: int, critic: int, actions: int, hidden: int) -> None:
        super().__init__()
        self.policy_norm, self.critic_norm = Normaliser(policy), Normaliser(critic)
        self.actor = network([policy, hidden, hidden, actions])
        self.critic = network([critic, hidden, hidden, 1])
        self.log_std = nn.Parameter(torch.full((actions,), -0.2))

    def act(self, observation: Tensor) -> torch.distributions.Normal:
        """The distribution of the actions."""
        return torch.distributions.Normal(self.actor(self.policy_norm(observation)), self.log_std.exp())

    def value(self, observation: Tensor) -> Tensor:
        """(N,) values."""
        return self.critic(self.critic_norm(observation)).squeeze(-1)


def roll_out(env: GymnasiumEnv, agent: Agent, seen: dict[str, Tensor], s: Settings) -> tuple[dict[str, Tensor], dict]:
    """``s.steps`` steps of all worlds as tensors (T, N, ...), with advantages; and the observations that follow."""
    rows: dict[str, list[Tensor]] = {name: [] for name in ("policy", "critic", "action", "logp", "value", "reward")}
    ends, cuts = [], []  # 1 - terminated; value of the last observation of a truncated world
    for _ in range(s.steps):
        with torch.no_grad():
            chosen = agent.act(seen["policy"])
            action = chosen.sample()
            now = {
                **seen,
                "action": action,
                "logp": chosen.log_prob(action).sum(-1),
                "value": agent.value(seen["critic"]),
            }
        observation, reward, terminated, truncated, info = env.step(action.numpy())
        last = torch.zeros(env.num_envs)
        for world in np.flatnonzero(truncated):  # cut off, not over: what would have come is estimated
            with torch.no_grad():
                last[world] = agent.value(torch.from_numpy(info["final_obs"][world]["critic"])[None])[0]
        for name, values in (now | {"reward": torch.from_numpy(reward)}).items():
            rows[name].append(values)
        ends.append(1.0 - torch.from_numpy(terminated | truncated).float())
        cuts.append(last)
        seen = {name: torch.from_numpy(part) for name, part in observation.items()}
    batch = {name: torch.stack(values) for name, values in rows.items()}
    batch["reward"] += s.gamma * torch.stack(cuts)
    with torch.no_grad():
        batch["advantage"] = advantages(batch, torch.stack(ends), agent.value(seen["critic"]), s)
    return batch, seen


def advantages(batch: dict[str, Tensor], goes_on: Tensor, last: Tensor, s: Settings) -> Tensor:
    """Generalised advantages (T, N)."""
    result, running = torch.zeros_like(batch["reward"]), torch.zeros_like(last)
    for t in reversed(range(s.steps)):
        following = last if t == s.steps - 1 else batch["value"][t + 1]
        delta = batch["reward"][t] + s.gamma * following * goes_on[t] - batch["value"][t]
        result[t] = running = delta + s.gamma * s.gae_lambda * goes_on[t] * running
    return result


def improve(agent: Agent, optimiser: torch.optim.Optimizer, batch: dict[str, Tensor], s: Settings) -> float:
    """One update; the last loss."""
    flat = {name: values.flatten(0, 1) for name, values in batch.items()}
    agent.policy_norm.update(flat["policy"])
    agent.critic_norm.update(flat["critic"])
    flat["return"] = flat["advantage"] + flat["value"]
    loss = torch.zeros(())
    for _ in range(s.epochs):
        for index in torch.randperm(len(flat["reward"])).chunk(s.minibatches):
            part = {name: values[index] for name, values in flat.items()}
            chosen = agent.act(part["policy"])
            ratio = (chosen.log_prob(part["action"]).sum(-1) - part["logp"]).exp()
            gain = (part["advantage"] - part["advantage"].mean()) / (part["advantage"].std() + 1e-8)
            surrogate = torch.min(ratio * gain, ratio.clamp(1 - s.clip, 1 + s.clip) * gain).mean()
            value_loss = (agent.value(part["critic"]) - part["return"]).square().mean()
            loss = value_loss - surrogate - s.entropy * chosen.entropy().sum(-1).mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
            optimiser.step()
    return float(loss.detach())


def train(env: GymnasiumEnv, s: Settings) -> list[float]:
    """Train, print a line per update, and return the mean reward of each."""
    torch.manual_seed(s.seed)
    observation, _ = env.reset(seed=s.seed)
    seen = {name: torch.from_numpy(part) for name, part in observation.items()}
    sizes = (seen["policy"].shape[1], seen["critic"].shape[1], env.env.worlds.nominal.shape[0])
    agent = Agent(*sizes, s.hidden)
    agent.policy_norm.update(seen["policy"])
    agent.critic_norm.update(seen["critic"])
    optimiser = torch.optim.Adam(agent.parameters(), lr=s.learning_rate)
    rewards = []
    for update in range(1, s.updates + 1):
        batch, seen = roll_out(env, agent, seen, s)
        loss = improve(agent, optimiser, batch, s)
        rewards.append(float(batch["reward"].mean()))
        print(f"update {update} | mean reward {rewards[-1]:.4f} | loss {loss:.3f}", flush=True)
    return rewards


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description="PPO on the gymnasium vector environment.")
    parser.add_argument("--worlds", type=int, default=Settings.worlds)
    parser.add_argument("--updates", type=int, default=Settings.updates)
    parser.add_argument("--seed", type=int, default=Settings.seed)
    options = parser.parse_args()
    env = GymnasiumEnv(pace.make_env(options.worlds, device="cpu", seed=options.seed))
    train(env, Settings(worlds=options.worlds, updates=options.updates, seed=options.seed))


if __name__ == "__main__":
    main()
