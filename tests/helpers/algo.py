"""A learner small enough for tests."""

from __future__ import annotations

import torch

from pace.config.training import AlgoConfig, load_train_config

CPU = torch.device("cpu")


def small_algo(**changes: object) -> AlgoConfig:
    config = load_train_config(["algo.actor_hidden=[32,16]", "algo.critic_hidden=[32]", "algo.autocast=fp32"]).algo
    for name, value in changes.items():
        setattr(config, name, value)
    return config
