"""A third engine from outside: a puppet whose joints are where they are told to be."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from pace.config.base import ConfigError
from pace.rl.policies import load_policy
from pace.rl.train import main as train
from pace.task.env import TableTennisEnv
from tests.helpers.envs import make_env
from tests.helpers.outside import SMALL, command, stranger, write_module

PUPPET = """
    import torch
    from pace.sim.engine.base import StateTensors

    class Puppet(StateTensors):
        def __init__(self, model, options, num_worlds, device, substeps):
            super().__init__(model, num_worlds, device, substeps, options.physics_dt)
            self.qpos, self.qvel = self.qpos_path[:, -1].clone(), self.qvel_path[:, -1].clone()
            self.warmstart = torch.zeros_like(self.qvel)

        def _solver_state(self):
            return {"qpos": self.qpos, "qvel": self.qvel, "warmstart": self.warmstart}

        def advance(self, targets, applied):
            last = self.qpos_path[:, -1].clone()
            self.qpos_path.copy_(last.unsqueeze(1))
            self.qpos_path[:, 1:, 7:] = targets
            joints = self.qpos_path[:, :, 7:]
            self.qvel_path.zero_()
            self.qvel_path[:, 1:, 6:] = (joints[:, 1:] - joints[:, :-1]) / self.physics_dt

        def apply_params(self, mask): ...
        def add_velocity(self, delta): ...
        def overflowed(self): return False
        def state_dict(self): return {"qpos_path": self.qpos_path, "qvel_path": self.qvel_path}
        def load_state_dict(self, state):
            for name, value in self.state_dict().items():
                value.copy_(state[name])
"""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    write_module(tmp_path / "outside", "outside_puppet", PUPPET)
    with stranger(tmp_path / "outside"):
        yield tmp_path


def puppets() -> TableTennisEnv:
    chosen = ["engine.name=outside_puppet:Puppet", "randomization=none", "sensing=clean"]
    return make_env(3, "auto", "cpu", overrides=chosen)


def test_a_third_engine_plays_the_task(folder: Path) -> None:
    env = puppets()
    assert type(env.worlds.engine).__name__ == "Puppet"
    action = torch.full((3, 21), 0.4)
    for _ in range(91):  # as long as a serve lasts that the ball's rebound from the body prolongs
        env.advance(action)
        env.reset_worlds(env.terminated | env.truncated)
    told = env.worlds.nominal + env.config.robot.action_scale * action
    torch.testing.assert_close(env.worlds.robot.joint_position, told)
    assert env.first_bad() is None
    assert float(env.pop_statistics()["serves"]) >= 3.0


def test_its_state_is_saved_and_put_back(folder: Path) -> None:
    env = puppets()
    env.advance(torch.randn(3, 21))
    state = env.state_dict()
    env.advance(torch.ones(3, 21))
    expected = env.policy_observation.clone()
    other = puppets()
    other.load_state_dict(state)
    other.advance(torch.ones(3, 21))
    assert torch.equal(other.policy_observation, expected)


@pytest.mark.slow
def test_a_policy_is_trained_in_it_and_plays_in_it_or_in_another(folder: Path) -> None:
    run = folder / "run"
    assert command(train, f"out={run}", "engine.name=outside_puppet:Puppet", *SMALL) == 0
    policy = load_policy(run)
    assert type(policy.make_env(2, "cpu").worlds.engine).__name__ == "Puppet"
    with stranger():
        with pytest.raises(ConfigError, match=r"plugins=\[outside_puppet\]"):
            policy.make_env(2, "cpu")
        env = policy.make_env(2, "cpu", 1, ["engine=native", "engine.threads=1"])
        assert type(env.worlds.engine).__name__ == "NativeEngine"


def test_what_is_no_engine_is_named(folder: Path) -> None:
    write_module(folder / "outside", "outside_number", "seven = 7\n")
    with pytest.raises(ConfigError, match=r"engine 'outside_number:seven': a class that meets"):
        make_env(2, "auto", "cpu", overrides=["engine.name=outside_number:seven"])
