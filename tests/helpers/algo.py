"""A learner small enough for tests."""

from __future__ import annotations

import torch

from pace.config.training import AlgoConfig, load_train_config

CPU = torch.device("cpu")
#: Schedules that do not depend on the plan, for runs whose parts have other limits than the whole.
IN_SAMPLES = ("algo.entropy=[{samples: 0, value: 0.004}]", "algo.std=[{samples: 0, value: 1.0}]")


def small_algo(**changes: object) -> AlgoConfig:
    config = load_train_config(["algo.actor_hidden=[32,16]", "algo.critic_hidden=[32]", "algo.autocast=fp32"]).algo
    for name, value in changes.items():
        setattr(config, name, value)
    return config
