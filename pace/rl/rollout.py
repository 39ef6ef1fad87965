"""The rollout of one update, in storage that is allocated once.

TorchRL's Collector costs 21 ms a control step for 1,024 worlds, more than the physics. This loop calls the same
environment through its in-place interface instead, and passes the result to TorchRL's GAE and ClipPPOLoss. Observations
are normalised and stored once, in the number format of the networks: the policy learns from bit for bit the same
numbers that it acted on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor
from torchrl.objectives.value.functional import generalized_advantage_estimate

from pace.arrays.graph import Graphs
from pace.distributed import ProcessGroup
from pace.predictor.regression import PredictorSource
from pace.rl.agent import Agent
from pace.sim.replay import WorldReplay

CRITIC_ROWS = 8192  # rows of one critic pass after the rollout: bounds the memory of its activations


class RolloutError(RuntimeError):
    """Training cannot continue with a value of the worlds; the message names the world and the quantity."""


def require_finite(metrics: Mapping[str, float]) -> None:
    """Errors: :class:`RolloutError` that names the first metric of an update that is not finite."""
    for name, value in metrics.items():
        if not math.isfinite(value):
            raise RolloutError(f"not finite: {name} of the update")


class VectorTask(Protocol):
    """In-place interface of the N worlds, all tensors on ``device``; see :class:`pace.rl.TableTennisEnv`."""

    policy_observation: Tensor  # (N, Dp) float32
    critic_observation: Tensor  # (N, Dc) float32
    reward: Tensor  # (N,) float32
    terminated: Tensor  # (N,) bool
    truncated: Tensor  # (N,) bool
    graphs: Graphs  # how its calls are captured, and those around them may be
    generator: torch.Generator  # source of its random numbers

    def advance(self, action: Tensor) -> None:
        """One control step; afterwards the observations are those before any reset."""

    def reset_worlds(self, mask: Tensor) -> None:
        """Reset the masked worlds (N,) and refresh their observations."""

    def first_bad(self) -> str | None:
        """World and term of the first value that is not finite, or None."""


class TrainableTask(VectorTask, PredictorSource, Protocol):
    """What the trainer asks of an environment beyond the rollout's interface."""

    action_spec: Any

    def pop_statistics(self) -> dict[str, Tensor]:
        """Sums since the last call, 0-d tensors: serves, hits, successes, falls, episodes, steps, rewards, ..."""
        ...

    def replays(self) -> list[WorldReplay]:
        """The last control steps of worlds whose numbers went wrong since the last call. Waits for the device."""
        ...

    def warn_of_overflow(self) -> None:
        """Warn, once, of worlds whose contacts exceeded the engine's memory. May wait for the device."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next control step depends on."""
        ...

    def load_state_dict(self, state: dict[str, Any], /) -> None:
        """Restore the result of :meth:`state_dict`."""
        ...


class Rollout:
    """``steps`` control steps of N worlds: (steps, N, ...) tensors, and what GAE makes of them.

    A world may be truncated at most once in a rollout (rollouts are shorter than episodes), so one (N, Dc) buffer holds
    all terminal critic observations and no step waits for the host. :meth:`fault` reports a world that breaks this.
    """

    def __init__(self, env: VectorTask, agent: Agent, steps: int) -> None:
        worlds, policy_size = env.policy_observation.shape
        device = env.policy_observation.device
        critic_size = env.critic_observation.shape[1]
        self.env, self.agent, self.steps, self.num_worlds = env, agent, steps, worlds
        self.policy = torch.zeros(steps, worlds, policy_size, dtype=agent.observation_dtype, device=device)
        # rows `steps` and `steps + 1`: the observation after the last step, and that of truncated worlds before reset
        self.critic = torch.zeros(steps + 2, worlds, critic_size, dtype=agent.critic.dtype, device=device)
        self.action = torch.zeros(steps, worlds, agent.num_actions, device=device)
        self.loc = torch.zeros_like(self.action)
        self.scale = torch.ones(agent.num_actions, device=device)
        self.log_prob = torch.zeros(steps, worlds, device=device)
        self.reward = torch.zeros(steps, worlds, device=device)
        self.terminated = torch.zeros(steps, worlds, dtype=torch.bool, device=device)
        self.truncated = torch.zeros(steps, worlds, dtype=torch.bool, device=device)
        self.value = torch.zeros(steps + 2, worlds, device=device)
        self.advantage = torch.zeros(steps, worlds, device=device)
        self.value_target = torch.zeros(steps, worlds, device=device)
        self._last_critic = torch.zeros(worlds, critic_size, device=device)
        self._noise = torch.zeros(worlds, agent.num_actions, device=device)
        self._done = torch.zeros(worlds, dtype=torch.bool, device=device)

    @torch.no_grad()
    def begin(self) -> None:
        """Freeze the policy's standard deviation for this rollout; call it before the first :meth:`step`."""
        self.scale.copy_(self.agent.actor.std)
        self._last_critic.copy_(self.env.critic_observation)

    @torch.no_grad()
    def step(self, t: int) -> None:
        """Observe, act, step, reset: row ``t`` of the storage."""
        env, agent = self.env, self.agent
        agent.policy_norm.update(env.policy_observation)
        agent.critic_norm.update(env.critic_observation)
        agent.policy_norm.normalise_into(env.policy_observation, self.policy[t])
        agent.critic_norm.normalise_into(env.critic_observation, self.critic[t])
        self._act(t)
        env.advance(self.action[t])
        self.reward[t].copy_(env.reward)
        self.terminated[t].copy_(env.terminated)
        self.truncated[t].copy_(env.truncated)
        torch.where(env.truncated[:, None], env.critic_observation, self._last_critic, out=self._last_critic)
        torch.logical_or(env.terminated, env.truncated, out=self._done)
        env.reset_worlds(self._done)

    def _act(self, t: int) -> None:
        self._noise.normal_()
        self.loc[t].copy_(self.agent.actor.mlp(self.policy[t]))
        torch.addcmul(self.loc[t], self._noise, self.scale, out=self.action[t])
        constant = self.scale.log().sum() + 0.5 * math.log(2.0 * math.pi) * self.agent.num_actions
        self.log_prob[t].copy_(self._noise.square().sum(1).mul_(-0.5).sub_(constant))

    @torch.no_grad()
    def finish(self, gamma: float, gae_lambda: float) -> None:
        """Values of all stored observations in one pass, then advantages and value targets."""
        norm = self.agent.critic_norm
        norm.normalise_into(self.env.critic_observation, self.critic[self.steps])
        norm.normalise_into(self._last_critic, self.critic[self.steps + 1])
        rows, values = self.critic.flatten(0, 1), self.value.view(-1)
        for part, out in zip(rows.split(CRITIC_ROWS), values.split(CRITIC_ROWS), strict=True):
            out.copy_(self.agent.critic(part).squeeze(-1))
        self.estimate_advantage(gamma, gae_lambda)

    def estimate_advantage(self, gamma: float, gae_lambda: float) -> None:
        """GAE from the stored values. Truncated steps bootstrap from their terminal state, terminated ones do not."""
        terminal = self.value[self.steps + 1]
        next_value = torch.where(self.truncated, terminal, self.value[1 : self.steps + 1])
        done = self.terminated | self.truncated
        advantage, target = generalized_advantage_estimate(
            gamma, gae_lambda, self.value[: self.steps], next_value, self.reward, done, self.terminated
        )
        self.advantage.copy_(advantage)
        self.value_target.copy_(target)

    @torch.no_grad()
    def explained_variance(self, group: ProcessGroup) -> Tensor:
        """Share of the variance of the value targets of all processes that the stored values explain, (); at most 1."""
        both = torch.stack([self.value_target, self.value_target - self.value[: self.steps]]).flatten(1)
        mean = both.mean(1, keepdim=True)
        group.all_reduce_mean_([mean])
        variance = (both - mean).square().mean(1)
        group.all_reduce_mean_([variance])
        return 1.0 - variance[1] / (variance[0] + torch.finfo(variance.dtype).eps)

    def healthy(self) -> Tensor:
        """Whether there is no :meth:`fault`, ()."""
        return self._finite() & ~self._twice()

    def fault(self) -> str | None:
        """A fault that ends training: a value that is not finite, or two truncations of one world. Waits for the
        device."""
        if not bool(self._finite()):
            return self._describe_fault()
        if bool(self._twice()):
            return f"a world was truncated twice within {self.steps} steps: algo.steps must be shorter than an episode"
        return None

    def _finite(self) -> Tensor:
        finite = self.agent.policy_norm.finite & self.agent.critic_norm.finite
        return finite & torch.isfinite(self.reward).all() & torch.isfinite(self.value).all()

    def _twice(self) -> Tensor:
        return (self.truncated.sum(0) > 1).any()

    def _describe_fault(self) -> str:
        """Name and position of the first value that is not finite; only called if there is one."""
        parts: list[str] = []
        for name, values in (("policy", self.policy), ("critic", self.critic), ("reward", self.reward)):
            bad = (~torch.isfinite(values)).nonzero()
            if len(bad):
                where = bad[0].tolist()
                column = f" column {where[2]}" if len(where) > 2 else ""
                moment = f"at step {where[0]}" if where[0] < self.steps else "at the end"
                parts.append(f"{name}{column} of world {where[1]} {moment} of the rollout")
        parts = parts[:1] or ["an infinite observation, or a value of the critic"]
        named = self.env.first_bad()
        return f"not finite: {parts[0]}" + (f"; {named}" if named else "")
