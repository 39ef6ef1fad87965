"""Runs on disk without training: small networks with random weights."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from pace.config import TrainConfig, load_train_config, to_dict
from pace.predictor.network import PredictorNetwork
from pace.rl.checkpoint import Checkpoint, save_checkpoint
from pace.rl.loading import policy_size
from pace.rl.policy import Agent

OVERRIDES = ("algo.actor_hidden=[8]", "algo.critic_hidden=[8]", "algo.autocast=fp32", "reward.scale=0.125")


@lru_cache
def make_config() -> TrainConfig:
    """The default task with tiny networks, and a reward scale by which a saved configuration can be told.

    Shared by the tests, so not to be changed.
    """
    return load_train_config(list(OVERRIDES))


def make_agent(config: TrainConfig) -> Agent:
    """The same weights at each call; a normaliser that has seen data."""
    torch.manual_seed(11)
    agent = Agent(policy_size(config), 4, 21, config.algo, torch.device("cpu"))
    agent.policy_norm.update(torch.randn(64, policy_size(config)) * 2.0 + 1.0)
    return agent


def save_run(path: Path, agent: dict[str, Tensor] | None = None, without: str = "") -> Path:
    """A run folder with one checkpoint of weights; ``agent`` replaces those, the part ``without`` is left out."""
    config = make_config()
    weights = {
        "agent": agent or make_agent(config).state_dict(),
        "predictor": PredictorNetwork(config.predictor).state_dict(),
    }
    weights.pop(without, None)
    checkpoint = Checkpoint(to_dict(config), {"updates": 3, "samples": 99, "wall_s": 1.0}, weights, None)
    save_checkpoint(path / "checkpoints" / "update_00000003", checkpoint)
    return path
