"""Algorithms from outside: REINFORCE from nothing, and PPO with a change; the real trainer runs them by name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from pace.config.base import ConfigError
from pace.deploy.__main__ import main as export
from pace.evaluation.__main__ import main as evaluate
from pace.predictor.network import PredictorNetwork
from pace.rl.algorithm import ALGORITHMS
from pace.rl.policies import load_policy
from pace.rl.train import main as train
from pace.rl.trainer import Trainer
from pace.runs.checkpoint import CheckpointError, load_checkpoint
from pace.runs.metrics import read_metrics
from pace.runs.run_folder import RunFolder
from tests.helpers.dummy import DummyTask
from tests.helpers.outside import SMALL, command, stranger, write_module

REINFORCE = """
    import torch
    from torch import nn
    from pace.runs.checkpoint import load_weights
    from pace.runs.optimiser import load_optimiser_state, optimiser_state

    class Reinforce:
        '''Policy gradient with a linear policy, a fixed standard deviation and the mean return as baseline.'''

        def __init__(self, sizes, config, device, group):
            self.config, self.sizes, self.group = config, sizes, group
            self.agent = nn.Linear(sizes.policy, sizes.actions).to(device)
            nn.init.zeros_(self.agent.weight)
            self.std = config.params.get("std", 0.3)
            self.optimiser = torch.optim.Adam(self.agent.parameters(), lr=config.params.get("rate", 0.01))

        def prepare(self, env, at):
            self.env, steps, worlds = env, self.config.steps, len(env.reward)
            self.seen = torch.zeros(steps, worlds, self.sizes.policy)
            self.action = torch.zeros(steps, worlds, self.sizes.actions)
            self.reward, self.done = torch.zeros(steps, worlds), torch.zeros(steps, worlds)
            return steps

        def begin(self): ...

        @torch.no_grad()
        def step(self, t):
            env = self.env
            self.seen[t] = env.policy_observation
            self.action[t] = self.agent(self.seen[t]) + self.std * torch.randn(self.action[t].shape)
            env.advance(self.action[t])
            done = env.terminated | env.truncated
            self.reward[t], self.done[t] = env.reward, done
            env.reset_worlds(done)

        def finish(self):
            self.returns, rest = torch.zeros_like(self.reward), torch.zeros_like(self.reward[0])
            for t in reversed(range(len(self.reward))):
                rest = self.reward[t] + self.config.gamma * rest * (1.0 - self.done[t])
                self.returns[t] = rest

        def fault(self):
            return None if bool(self.returns.isfinite().all()) else "a return is not finite"

        def update(self, at):
            advantage = self.returns - self.returns.mean()
            miss = (self.action - self.agent(self.seen)).square().sum(2) / (2.0 * self.std**2)
            loss = (miss * advantage / (advantage.std() + 1e-8)).mean()
            self.optimiser.zero_grad()
            loss.backward()
            self.group.all_reduce_mean_([parameter.grad for parameter in self.agent.parameters()])
            self.optimiser.step()
            return {"policy_loss": loss.item()}

        def weights_loaded(self, new_run): ...
        def describe(self): return "a linear policy"
        def state_dict(self): return optimiser_state(self.optimiser)
        def load_state_dict(self, state): load_optimiser_state(self.optimiser, state)

        @staticmethod
        def load_policy(weights, sizes, config, source):
            policy = nn.Linear(sizes.policy, sizes.actions)
            load_weights(policy, weights, f"{source} (policy)")
            return policy
"""
CALM = """
    from pace.rl.algorithm import ALGORITHMS
    from pace.rl.ppo import AsymmetricPPO

    class CalmPPO(AsymmetricPPO):
        def update(self, at):
            metrics = super().update(at)
            self.agent.actor.bound_std(0.0, self.config.params["largest_std"])
            return metrics | {"policy_std": self.agent.actor.std.mean().item()}

    ALGORITHMS["calm"] = CalmPPO
"""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    write_module(tmp_path / "outside", "outside_reinforce", REINFORCE)
    write_module(tmp_path / "outside", "outside_calm", CALM)
    with stranger(tmp_path / "outside"):
        yield tmp_path


@pytest.mark.slow
def test_reinforce_trains_resumes_exactly_and_is_evaluated_and_exported(folder: Path) -> None:
    chosen = ["algo.algorithm=outside_reinforce:Reinforce", "+algo.params.std=0.2"]
    arguments = [argument for argument in SMALL if not argument.startswith("samples")]
    for run, samples in (("whole", 128), ("parts", 64)):
        assert command(train, f"out={folder / run}", f"samples={samples}", *chosen, *arguments) == 0
    assert command(train, f"resume={folder / 'parts'}", "samples=128", "progress=false") == 0
    whole, parts = load_checkpoint(folder / "whole"), load_checkpoint(folder / "parts")
    assert whole.counters["updates"] == parts.counters["updates"] == 4
    for name, tensor in whole.weights["agent"].items():
        assert torch.equal(tensor, parts.weights["agent"][name])
        assert tensor.abs().max().item() > 0
    losses = [read_metrics(folder / run / "metrics.csv")["policy_loss"] for run in ("whole", "parts")]
    assert losses[0] == losses[1]
    policy = load_policy(folder / "whole")
    seen = torch.randn(3, whole.weights["agent"]["weight"].shape[1])
    torch.testing.assert_close(policy(seen), seen @ whole.weights["agent"]["weight"].T + whole.weights["agent"]["bias"])
    table = ("rows=[short]", "serves=4", "num_worlds=4", "engine.threads=1", "progress=false", "physics_dt=0.01")
    table += ("first_ball=[]",)
    assert command(evaluate, str(folder / "whole"), f"out={folder / 'table'}", *table) == 0
    assert command(export, str(folder / "whole"), f"out={folder / 'exported'}", "check_worlds=2", "check_steps=3") == 0
    assert (folder / "exported").exists()
    with stranger():
        with pytest.raises(CheckpointError, match=r"plugins=\[outside_reinforce\]"):
            load_policy(folder / "whole")
        assert command(train, f"resume={folder / 'whole'}", "samples=256", "progress=false") == 2


def test_it_learns_the_dummy_task(folder: Path) -> None:
    from pace.config.training import load_train_config

    chosen = ["algo.algorithm=outside_reinforce:Reinforce", "+algo.params.rate=0.05", "algo.steps=12"]
    config = load_train_config([*chosen, "num_worlds=64", f"samples={60 * 64 * 12}", "minutes=0", "progress=false"])
    torch.manual_seed(1)
    run = RunFolder(folder / "run", {}, False)
    Trainer(config, DummyTask(64), PredictorNetwork(config.predictor), run).train()
    reward = read_metrics(folder / "run" / "metrics.csv")["mean_reward"]
    assert sum(reward[-5:]) / 5 > 0.7 * reward[0]  # rewards are negative distances


def test_a_changed_ppo_is_entered_under_a_name(folder: Path) -> None:
    run = folder / "run"
    chosen = ("algo.algorithm=calm", "+algo.params.largest_std=0.25")
    assert command(train, f"out={run}", *chosen, *SMALL) == 2  # nobody has named the module
    assert command(train, f"out={run}", "plugins=[outside_calm]", *chosen, *SMALL) == 0
    assert max(read_metrics(run / "metrics.csv")["policy_std"]) == pytest.approx(0.25)
    assert load_policy(run).config.algo.algorithm == "calm"


def test_what_is_no_algorithm_is_named(folder: Path) -> None:
    assert command(train, "algo.algorithm=outside_reinforce:torch", f"out={folder / 'run'}", *SMALL) == 2
    with pytest.raises(ConfigError, match=r"a class that meets pace.rl.algorithm.Algorithm"):
        ALGORITHMS["outside_reinforce:torch"]
