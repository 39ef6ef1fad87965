"""A small vector task with the in-place interface of the table-tennis environment: steer a point to a target.

The reward is ``-|position - target|``, the action moves the point. Worlds that stray too far terminate, episodes of
``length`` steps are truncated. The "ball" of its predictor is a straight line, whose end is to be predicted.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data import Unbounded

from pace.arrays.graph import Graphs
from pace.sim.replay import WorldReplay

STATE = (
    "position", "target", "ball", "ball_velocity", "age", "policy_observation", "critic_observation", "predictor_input",
    "predictor_target", "predictor_time_to_apex",
)  # fmt: skip


class DummyTask:
    """N independent points in the plane; see the module's docstring."""

    def __init__(
        self, num_worlds: int = 32, seed: int = 1, length: int = 20, outputs: int = 7, graphs: Graphs = Graphs.NONE
    ) -> None:
        self.num_worlds, self.length, self.outputs = num_worlds, length, outputs
        self.device = torch.device("cpu")
        self.graphs = graphs
        self.generator = torch.Generator().manual_seed(seed)
        self.action_spec = Unbounded(torch.Size([num_worlds, 2]))
        self.position = torch.zeros(num_worlds, 2)
        self.target = torch.zeros(num_worlds, 2)
        self.ball = torch.zeros(num_worlds, 3)
        self.ball_velocity = torch.zeros(num_worlds, 3)
        self.age = torch.zeros(num_worlds, dtype=torch.long)
        self.policy_observation = torch.zeros(num_worlds, 6)
        self.critic_observation = torch.zeros(num_worlds, 7)
        self.reward = torch.zeros(num_worlds)
        self.terminated = torch.zeros(num_worlds, dtype=torch.bool)
        self.truncated = torch.zeros(num_worlds, dtype=torch.bool)
        self.predictor_input = torch.zeros(num_worlds, 15)
        self.predictor_target = torch.zeros(num_worlds, outputs)
        self.predictor_valid = torch.ones(num_worlds, dtype=torch.bool)
        self.predictor_time_to_apex = torch.zeros(num_worlds)
        names = ("serves", "hits", "successes", "falls", "episodes", "steps", "reward_sum", "reward/distance")
        self.statistics = {name: torch.zeros(()) for name in names}
        self.poison_step = -1  # count of steps until a NaN appears; negative: never
        self._start = torch.tensor([1.3, 0.0, 1.0])
        self._slowest, self._fastest = torch.tensor([-6.5, -0.8, -0.5]), torch.tensor([-5.0, 0.4, 0.5])
        self.reset_worlds(torch.ones(num_worlds, dtype=torch.bool))
        self.age.copy_(torch.randint(0, length, (num_worlds,), generator=self.generator))

    def advance(self, action: Tensor) -> None:
        self.position.add_(0.1 * action.clamp(-5, 5))
        self.age.add_(1)
        distance = (self.position - self.target).norm(dim=1)
        self.reward.copy_(-distance)
        self.terminated.copy_(distance > 4.0)
        self.truncated.copy_((self.age >= self.length) & ~self.terminated)
        self.poison_step -= 1
        if self.poison_step == 0:
            self.position[3, 1] = float("nan")
        self._observe()
        self._count(distance)

    def reset_worlds(self, mask: Tensor) -> None:
        def draw(low: float, high: float, size: int) -> Tensor:
            return low + (high - low) * torch.rand(self.num_worlds, size, generator=self.generator)

        masked = mask[:, None]
        self.position.copy_(torch.where(masked, draw(-1, 1, 2), self.position))
        self.target.copy_(torch.where(masked, draw(-1, 1, 2), self.target))
        self.ball.copy_(torch.where(masked, self._start + draw(-0.1, 0.1, 3), self.ball))
        low, high = self._slowest, self._fastest
        self.ball_velocity.copy_(torch.where(masked, low + (high - low) * draw(0, 1, 3), self.ball_velocity))
        self.age.masked_fill_(mask, 0)
        self._observe()

    def _observe(self) -> None:
        self.policy_observation.copy_(torch.cat([self.position, self.target, self.target - self.position], 1))
        self.critic_observation.copy_(torch.cat([self.policy_observation, self.age[:, None] / self.length], 1))
        time = 0.02 * (self.age[:, None] - torch.arange(4, -1, -1))
        noise = 0.002 * torch.randn(self.num_worlds, 5, 3, generator=self.generator)
        line = self.ball[:, None] + self.ball_velocity[:, None] * time[:, :, None] + noise
        self.predictor_input.copy_(line.reshape(self.num_worlds, 15))
        self.predictor_time_to_apex.copy_(0.5 - time[:, -1])
        end = self.ball + 0.5 * self.ball_velocity
        self.predictor_target[:, :3] = end
        if self.outputs == 7:
            self.predictor_target[:, 3:6] = end
            self.predictor_target[:, 6] = self.predictor_time_to_apex

    def _count(self, distance: Tensor) -> None:
        done = self.terminated | self.truncated
        near = (distance < 0.3) & done
        counts = {
            "serves": done, "hits": near, "successes": near, "falls": self.terminated, "episodes": done,
            "steps": torch.ones_like(distance), "reward_sum": self.reward, "reward/distance": self.reward,
        }  # fmt: skip
        for name, values in counts.items():
            self.statistics[name] += values.sum()

    def first_bad(self) -> str | None:
        bad = (~torch.isfinite(self.policy_observation)).any(1).nonzero()
        return f"term position of world {int(bad[0])}" if len(bad) else None

    def replays(self) -> list[WorldReplay]:
        """Nothing is remembered here."""
        return []

    def warn_of_overflow(self) -> None:
        """Nothing can overflow here."""

    def pop_statistics(self) -> dict[str, Tensor]:
        popped = {name: value.clone() for name, value in self.statistics.items()}
        for value in self.statistics.values():
            value.zero_()
        return popped

    def state_dict(self) -> dict[str, Any]:
        return {**{name: getattr(self, name).clone() for name in STATE}, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name in STATE:
            getattr(self, name).copy_(state[name])
        self.generator.set_state(state["generator"])
