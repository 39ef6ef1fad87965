"""The task as rsl_rl's ``VecEnv``. Needs rsl-rl-lib (extra ``interfaces``)."""

from __future__ import annotations

import math
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from pace.config.base import to_dict
from pace.config.task import ServeConfig
from pace.rl.rates import rates
from pace.runs.reading import read
from pace.task.env import TableTennisEnv

#: Control steps between two logs of rates, 0.5 s: in fewer steps few serves end.
LOG_EVERY = 24
ENDLESS = 10_000  # control steps that rsl_rl is told if episodes do not end


class RslRlEnv(VecEnv):
    """N worlds of table tennis for rsl_rl's runners.

    Observation groups are ``policy`` (N, Dp), what the robot can know, and ``critic`` (N, Dc), the truth:
    ``obs_groups={"actor": ["policy"], "critic": ["critic"]}``. A step returns copies: rsl_rl stores the observations
    of a step after the next one. Worlds that are done are reset in the same step; those that are truncated are
    ``extras["time_outs"]``. Every ``log_every`` steps ``extras["log"]`` has the hit, return and fall rates and the mean
    of each reward term since the last time.

    Attributes: those of ``rsl_rl.env.VecEnv``; ``env`` the task.

    Args: env: as :func:`pace.make_env` gives it, on the device that rsl_rl trains on.
    """

    def __init__(self, env: TableTennisEnv, log_every: int = LOG_EVERY) -> None:
        self.env, self.num_envs, self.device = env, env.num_worlds, env.worlds.device
        self.num_actions = env.worlds.nominal.shape[0]
        self.cfg = to_dict(env.config)
        self.max_episode_length = longest_episode(env.config.serve, env.worlds.control_dt)
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self._log_every, self._steps = log_every, 0
        env.pop_statistics()

    def get_observations(self) -> TensorDict:
        """The current observations, as copies."""
        groups = {"policy": self.env.policy_observation.clone(), "critic": self.env.critic_observation.clone()}
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Begin new episodes in all worlds."""
        self.env.reset_worlds(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))
        self.episode_length_buf.zero_()
        return self.get_observations(), {}

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One control step with ``actions`` (N, J): observations, rewards (N,), done (N,) bool and extras."""
        with torch.inference_mode(False):  # else tensors of the environment could not be changed outside of the runner
            env = self.env
            env.advance(actions)
            reward, time_outs = env.reward.clone(), env.truncated.clone()
            done = env.terminated | env.truncated
            env.reset_worlds(done)
            self.episode_length_buf = (self.episode_length_buf + 1).masked_fill_(done, 0)
            return self.get_observations(), reward, done, {"time_outs": time_outs, **self._log()}

    def _log(self) -> dict[str, Any]:
        self._steps += 1
        if self._steps % self._log_every:
            return {}
        found = rates(read(self.env.pop_statistics()), self.env.worlds.control_dt)
        shown = ("hit_rate", "success_rate", "fall_rate", *(name for name in found if name.startswith("reward/")))
        return {"log": {f"/{name}": found[name] for name in shown if not math.isnan(found[name])}}


def longest_episode(serve: ServeConfig, control_dt: float) -> int:
    """Control steps of the longest episode; :data:`ENDLESS` if episodes do not end."""
    if not serve.serves_per_episode:
        return ENDLESS
    seconds = serve.serves_per_episode * (serve.max_duration + serve.pause[1]) + serve.first_pause[1]
    return math.ceil(seconds / control_dt)
