"""Runs on disk without training: small networks with random weights; and a trained policy that sees more."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pace.config.base import compose, parse, to_dict
from pace.config.commands import ExportConfig
from pace.config.training import TrainConfig, load_train_config
from pace.deploy.export import export_policy
from pace.predictor.network import PredictorNetwork
from pace.rl.agent import Agent, Policy
from pace.rl.policies import TaskPolicy, load_policy, policy_size
from pace.runs.checkpoint import Checkpoint, save_checkpoint
from pace.task.observations import POLICY, layout
from tests.helpers.robot import SPEC

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


def remembering_policy(weight: float = 0.01) -> TaskPolicy:
    """``pretrained/wide``, which hits, with the observations of ``observation=memory``.

    The new inputs have random weights of the size ``weight``, and are not normalised.
    """
    old = load_policy("pretrained/wide")
    assert isinstance(old.act, Policy)
    config = replace(old.config, observation=load_train_config(["observation=memory"]).observation)
    frame, history = config.observation.policy, config.observation.policy_history
    new = ("last_return", "sensed_delay")
    sensed = {"estimated_gravity": "projected_gravity"}  # and the others by the same name
    kept = [sensed.get(name, name.removeprefix("estimated_")) for name in frame if name not in new]
    assert kept == old.config.observation.policy
    old_columns = torch.ones(policy_size(config) // history, dtype=torch.bool)
    for name in new:
        old_columns[layout(frame, POLICY, len(SPEC.joints))[name]] = False
    old_columns = old_columns.repeat(history)
    network = Policy.build(policy_size(config), 21, config.algo)
    weights = old.act.state_dict()
    torch.manual_seed(5)
    for name, like in (
        ("mlp.layers.0.weight", weight * torch.randn(config.algo.actor_hidden[0], len(old_columns))),
        ("norm.mean", torch.zeros(len(old_columns))),
        ("norm.var", torch.ones(len(old_columns))),
    ):
        wide = like.to(weights[name].dtype)
        wide[..., old_columns] = weights[name]
        weights[name] = wide
    network.load_state_dict(weights)
    return TaskPolicy(config, network.requires_grad_(False).eval(), old.predictor, "remembering")


def export_quickly(policy: TaskPolicy, folder: Path) -> Path:
    """An exported policy with its contract, checked on few observations; skips where the packages are missing."""
    pytest.importorskip("onnxscript")
    file = folder / "policy.onnx"
    small = ["run=any", "check_worlds=2", "check_steps=30"]
    export_policy(policy, file, parse(compose("export", small), ExportConfig))
    return file
