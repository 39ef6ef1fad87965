"""A predictor from outside trains in the regression and plays; its scales are those of the serves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from pace.config.base import ConfigError
from pace.predictor.__main__ import main as practise
from pace.predictor.network import PREDICTORS
from pace.rl.policies import load_policy, load_predictor
from pace.rl.train import main as train
from pace.runs.checkpoint import load_checkpoint
from pace.runs.metrics import read_metrics
from tests.helpers.outside import SMALL, command, stranger, write_module

STRAIGHT = """
    import torch
    from torch import nn
    from pace.predictor import BallPredictor

    class Straight(BallPredictor):
        '''A linear map of the last two positions.'''

        def __init__(self, config):
            super().__init__(config)
            self.register_scaling("position", self.priors.position)
            self.layer = nn.Linear(6, self.output_size)

        def scaled(self, positions):
            last = positions[:, -6:].unflatten(1, (2, 3))
            newest = (last[:, 1] - self.position_centre) / self.position_scale
            step = 20.0 * (last[:, 1] - last[:, 0])
            return self.layer(torch.cat([newest, step], dim=1))
"""
CHOSEN = "predictor.features=outside_straight:Straight"


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    write_module(tmp_path / "outside", "outside_straight", STRAIGHT)
    with stranger(tmp_path / "outside"):
        yield tmp_path


@pytest.mark.slow
def test_it_trains_alone_and_with_a_policy_and_plays(folder: Path) -> None:
    alone, run = folder / "alone", folder / "run"
    limits = ("num_worlds=256", "samples=100e3", "minutes=0", "progress=false", "predictor.batches_per_update=40")
    assert command(practise, f"out={alone}", CHOSEN, *limits) == 0
    errors = read_metrics(alone / "metrics.csv")["predictor_rmse_cm"]
    assert errors[-1] < 0.85 * errors[0]  # a linear map: of 30 cm it learns 7
    assert type(load_predictor(alone).network).__name__ == "Straight"
    assert command(train, f"out={run}", CHOSEN, f"predictor_from={alone}", *SMALL) == 0
    policy = load_policy(run)
    env = policy.make_env(4, "cpu", 1, ["engine.threads=1"])
    assert env.actor.predictor is policy.predictor
    env.advance(policy(env.policy_observation))
    assert policy.predictor is not None
    torch.testing.assert_close(env.actor.prediction, policy.predictor(env.predictor_input))


@pytest.mark.slow
def test_it_learned_with_the_priors_of_its_serves_and_keeps_them(folder: Path) -> None:
    slow, next_run = folder / "slow", folder / "next"
    limits = ("num_worlds=64", "samples=1", "minutes=0", "progress=false")
    assert command(practise, f"out={slow}", CHOSEN, "serve.vx=[-4.5,-4.0]", *limits) == 0
    priors = load_checkpoint(slow).config["predictor"]["priors"]
    assert priors["launch_velocity"]["mean"] == pytest.approx([-4.25, -0.2, 1.75])
    assert command(train, f"out={next_run}", CHOSEN, f"predictor_from={slow}", *SMALL) == 0  # faster serves
    assert load_checkpoint(next_run).config["predictor"]["priors"] == priors
    policy = load_policy(next_run)
    assert policy.predictor is not None
    assert policy.predictor.output_centre[0].item() == pytest.approx(priors["apex"]["mean"][0])


def test_what_is_no_predictor_is_named(folder: Path) -> None:
    assert command(train, "predictor.features=outside_straight:torch", f"out={folder / 'run'}", *SMALL) == 2
    with pytest.raises(ConfigError, match=r"a subclass of pace\.predictor\.network\.BallPredictor"):
        PREDICTORS["outside_straight:torch"]
