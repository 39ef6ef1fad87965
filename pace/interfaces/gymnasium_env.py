"""The task as gymnasium's vector environment. Needs gymnasium 1.1 or newer (extra ``interfaces``).

``gymnasium.make_vec("pace.interfaces.gymnasium_env:pace/TableTennis-v0", num_envs=64)`` makes one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from torch import Tensor

from pace.config.base import ConfigError
from pace.rl.environment import PUBLISHED, make_env
from pace.task.env import TableTennisEnv

NAME = "pace/TableTennis-v0"
Array = NDArray[np.float32]
Info = dict[str, Any]


class GymnasiumEnv(VectorEnv):
    """N worlds of table tennis as a ``gymnasium.vector.VectorEnv`` of numpy arrays.

    Observations are a dictionary: ``policy`` (N, Dp), what the robot can know, and ``critic`` (N, Dc), the truth. With
    ``critic="info"`` they are the array ``policy`` alone and the truth is ``info["critic"]``. Actions (N, J) are in
    units of ``robot.action_scale`` rad from the nominal pose. ``metadata["autoreset_mode"]`` says how worlds begin
    again:

    - ``SAME_STEP``: ``step`` returns the first observation of the new episode; the last one of the old is
      ``info["final_obs"][i]`` for each world of the mask ``info["_final_obs"]`` (the truth of ``critic="info"``:
      ``info["final_info"]["critic"]``).
    - ``DISABLED``: ``step`` returns the last observations, and the caller resets with
      ``reset(options={"reset_mask": mask})``.

    Args:
        env: the task, such as :func:`pace.make_env` gives it; it is stepped in place and may be read.
        autoreset_mode: not ``NEXT_STEP``, in which worlds waste a step for each reset.
        critic: where the critic's observations go.
        copy: ``False`` returns, on a CPU, views of the environment's own memory, which the next step overwrites.

    Errors: :class:`pace.config.ConfigError` for ``NEXT_STEP``.
    """

    def __init__(
        self,
        env: TableTennisEnv,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
        critic: Literal["observation", "info"] = "observation",
        copy: bool = True,
    ) -> None:
        if autoreset_mode not in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
            raise ConfigError(f"autoreset_mode must be SAME_STEP or DISABLED, not {autoreset_mode}")
        if critic not in ("observation", "info"):
            raise ConfigError(f"critic must be observation or info, not {critic!r}")
        self.env, self.num_envs = env, env.num_worlds
        self.metadata = {"render_modes": [], "autoreset_mode": autoreset_mode, "render_fps": 1 / env.worlds.control_dt}
        self._same_step = autoreset_mode == AutoresetMode.SAME_STEP
        self._separate, self._copy = critic == "info", copy
        self._everyone = torch.ones(self.num_envs, dtype=torch.bool, device=env.worlds.device)
        self._make_spaces()

    def _make_spaces(self) -> None:
        env, clip = self.env, self.env.config.robot.action_clip
        joints = env.worlds.nominal.shape[0]
        self.single_action_space = spaces.Box(-clip, clip, (joints,), np.float32)
        self.action_space = spaces.Box(-clip, clip, (self.num_envs, joints), np.float32)
        groups = {"policy": env.policy_observation.shape[1], "critic": env.critic_observation.shape[1]}
        single: dict[str, spaces.Space[Any]] = {}
        batch: dict[str, spaces.Space[Any]] = {}
        for name, size in groups.items():
            single[name] = spaces.Box(-np.inf, np.inf, (size,), np.float32)
            batch[name] = spaces.Box(-np.inf, np.inf, (self.num_envs, size), np.float32)
        self.single_observation_space = single["policy"] if self._separate else spaces.Dict(single)
        self.observation_space = batch["policy"] if self._separate else spaces.Dict(batch)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Begin new episodes in all worlds, or in those of ``options["reset_mask"]`` (N,) bool; see gymnasium.

        Errors: ``ValueError`` for a mask of another shape.
        """
        super().reset(seed=seed)
        if seed is not None:
            self.env.generator.manual_seed(seed)
        mask = (options or {}).get("reset_mask")
        self.env.reset_worlds(self._everyone if mask is None else self._mask(mask))
        return self._observe()

    def _mask(self, mask: Any) -> Tensor:
        given = np.asarray(mask, dtype=np.bool_)
        if given.shape != (self.num_envs,):
            raise ValueError(f"reset_mask must have the shape ({self.num_envs},), not {given.shape}")
        return torch.from_numpy(given).to(self.env.worlds.device)

    def step(self, actions: Array) -> tuple[Any, Array, NDArray[np.bool_], NDArray[np.bool_], Info]:
        """One control step of all worlds with ``actions`` (N, J); see gymnasium and the class.

        Errors: ``ValueError`` for actions of another shape.
        """
        if np.shape(actions) != self.action_space.shape:
            raise ValueError(f"actions must have the shape {self.action_space.shape}, not {np.shape(actions)}")
        env = self.env
        env.advance(torch.from_numpy(np.asarray(actions, dtype=np.float32)).to(env.worlds.device))
        outcome = (_own(env.reward), _own(env.terminated), _own(env.truncated))
        done = outcome[1] | outcome[2]
        final: Info = {}
        if self._same_step and done.any():
            final = self._final(done)
            env.reset_worlds(env.terminated | env.truncated)
        observation, info = self._observe()
        return observation, *outcome, final | info

    def _observe(self) -> tuple[Any, Info]:
        give = _own if self._copy else _shared
        policy, critic = give(self.env.policy_observation), give(self.env.critic_observation)
        return (policy, {"critic": critic}) if self._separate else ({"policy": policy, "critic": critic}, {})

    def _final(self, done: NDArray[np.bool_]) -> Info:
        """The last observations of the worlds that are ``done``, as gymnasium hands them on."""
        which = np.flatnonzero(done)
        rows = torch.from_numpy(which).to(self.env.worlds.device)
        policy, critic = (_own(o[rows]) for o in (self.env.policy_observation, self.env.critic_observation))
        last: NDArray[Any] = np.full(self.num_envs, None, dtype=object)
        for row, world in enumerate(which):  # few in a step
            last[world] = policy[row] if self._separate else {"policy": policy[row], "critic": critic[row]}
        final: Info = {"final_obs": last, "_final_obs": done}
        if self._separate:
            whole = np.zeros((self.num_envs, critic.shape[1]), np.float32)
            whole[which] = critic
            final |= {"final_info": {"critic": whole, "_critic": done}, "_final_info": done}
        return final


def _shared(tensor: Tensor) -> Any:
    """The memory of ``tensor`` on a CPU as an array; a copy from a GPU."""
    return tensor.detach().cpu().numpy()


def _own(tensor: Tensor) -> Any:
    """A copy of ``tensor`` as an array."""
    return tensor.detach().clone().cpu().numpy()


def make_gymnasium_env(
    num_envs: int = 64,
    engine: str = "auto",
    device: str = "auto",
    seed: int = 1,
    overrides: Sequence[str] = (),
    predictor: str | Path | None = PUBLISHED,
    **settings: Any,
) -> GymnasiumEnv:
    """What ``gymnasium.make_vec`` calls; arguments of :func:`pace.make_env` and of :class:`GymnasiumEnv`."""
    return GymnasiumEnv(make_env(num_envs, engine, device, seed, overrides, predictor), **settings)


gymnasium.register(NAME, vector_entry_point=make_gymnasium_env)
