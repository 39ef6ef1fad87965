"""The table-tennis environment: N worlds of table tennis as a TorchRL environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from pace.config.base import ConfigError
from pace.config.task import TaskConfig
from pace.onboard.actor import Predictor
from pace.sim.worlds import Worlds
from pace.task.observations import check_critic, check_policy
from pace.task.table_tennis import TableTennis


class TableTennisEnv(TableTennis, EnvBase):
    """N worlds of a humanoid that returns serves; batch size [N].

    As a TorchRL environment: ``policy`` (N, Dp) and ``critic`` (N, Dc) float32 observations, ``action`` (N, J) in
    units of ``robot.action_scale`` rad from the nominal pose, ``reward``, ``terminated``, ``truncated`` and ``done``
    (N, 1). Under it lies an in-place interface without copies, :class:`pace.task.table_tennis.TableTennis`, with the
    attributes that are overwritten. The constructor resets all worlds.

    Args:
        config: the task.
        num_worlds: N.
        device: ``auto``, ``cpu``, ``cuda``, ...
        seed: of every random draw; the same seed on the same device repeats a run exactly (but for MuJoCo Warp on a
                GPU, which adds up in no fixed order).
        predictor: callable (N, 3 * frames) -> (N, P), used as it is at each step; ``None``: predictions are zero.
        worlds: simulation to use instead of a new one, on the same device and with its own generator.

    Errors: :class:`pace.config.ConfigError` for num_worlds < 1 and unknown names of observations or rewards.
    """

    def __init__(
        self,
        config: TaskConfig,
        num_worlds: int,
        device: str | torch.device = "auto",
        seed: int = 1,
        predictor: Predictor | None = None,
        worlds: Worlds | None = None,
    ) -> None:
        if num_worlds < 1:
            raise ConfigError(f"num_worlds must be at least 1, got {num_worlds}")
        check_policy(config)
        check_critic(config.observation.critic)
        worlds = worlds or Worlds(config, num_worlds, device)
        EnvBase.__init__(self, device=worlds.device, batch_size=(num_worlds,))
        TableTennis.__init__(self, config, worlds, seed, predictor)
        self._make_specs()

    def _make_specs(self) -> None:
        batch, device = self.batch_size, self.worlds.device

        def floats(size: int) -> Unbounded:
            return Unbounded(torch.Size((*batch, size)), dtype=torch.float32, device=device)

        def flag() -> Binary:
            return Binary(1, shape=torch.Size((*batch, 1)), dtype=torch.bool, device=device)

        self.observation_spec = Composite(
            policy=floats(self.policy_observation.shape[1]),
            critic=floats(self.critic_observation.shape[1]),
            shape=batch,
            device=device,
        )
        self.action_spec = floats(self.worlds.nominal.shape[0])
        self.reward_spec = floats(1)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=batch, device=device)

    def _observations(self) -> dict[str, Tensor]:
        return {"policy": self.policy_observation.clone(), "critic": self.critic_observation.clone()}

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.advance(tensordict["action"])
        terminated, truncated = self.terminated.unsqueeze(-1), self.truncated.unsqueeze(-1)
        result = {
            **self._observations(),
            "reward": self.reward.unsqueeze(-1).clone(),
            "terminated": terminated.clone(),
            "truncated": truncated.clone(),
            "done": terminated | truncated,
        }
        return TensorDict(result, batch_size=self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self.reset_worlds(self._everyone if mask is None else mask.reshape(self.num_worlds))
        return TensorDict(self._observations(), batch_size=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)
