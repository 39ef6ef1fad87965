"""What the predictor takes for granted: measured for one kind of serve, carried over to others, saved with weights."""

from __future__ import annotations

import pytest
import torch

from pace.config.base import to_dict
from pace.config.overrides import override_task
from pace.config.predictor import FlightFit, PredictorPriors
from pace.config.training import TrainConfig, load_train_config
from pace.config.upgrade import upgrade_config
from pace.predictor.network import make_predictor
from pace.predictor.priors import MEASURED_ON, Launches, derive_priors, resolve_priors
from pace.rl.policies import load_policy
from pace.rl.practice import ServePractice

SLOW = ["serve.vx=[-4.6,-4.2]", "serve.vz=[2.3,2.5]"]


def test_for_the_serves_they_were_measured_on_they_are_the_measured_ones_to_the_last_digit() -> None:
    assert derive_priors(MEASURED_ON, FlightFit()) == PredictorPriors()
    assert Launches.of(load_train_config()) == MEASURED_ON
    assert resolve_priors(load_train_config()).priors == PredictorPriors()


def test_they_move_with_the_serves_and_the_target() -> None:
    priors = derive_priors(Launches.of(load_train_config([*SLOW, "reward.target_x=-1.8"])), FlightFit())
    assert priors.launch_velocity.mean == pytest.approx([-4.4, -0.2, 2.4])
    assert priors.target.mean[0] == pytest.approx(-1.8)
    assert priors.launch_velocity.std[0] == pytest.approx(0.3)  # no less than half of what was measured
    assert priors.launch_velocity.std[1] == pytest.approx(0.5)
    assert priors.position == PredictorPriors().position  # of the table


def test_for_serves_with_limits_they_are_those_of_the_balls_that_are_accepted() -> None:
    config = load_train_config(["serve=machine", "num_worlds=1024"])
    priors, practice = derive_priors(Launches.of(config), config.predictor.fit), flown(config)
    for name in ("apex", "launch_velocity", "bounce", "target", "target_time"):
        prior = getattr(priors, name)
        assert torch.tensor([*prior.mean, *prior.std]).isfinite().all()
        assert min(prior.std) > 0
    apex = practice.predictor_target[practice.predictor_valid][:, :3]
    torch.testing.assert_close(torch.tensor(priors.apex.mean), apex.mean(0), atol=0.25, rtol=0.0)
    shares = torch.tensor(priors.apex.std) / apex.std(0)
    assert 1.0 < float(shares.min()) <= float(shares.max()) < 4.0


def flown(config: TrainConfig) -> ServePractice:
    """Serves a third of a second after the launch."""
    practice = ServePractice(config, torch.device("cpu"))
    for _ in range(14):
        practice.advance()
    return practice


def test_the_derived_priors_are_where_the_balls_are() -> None:
    config = load_train_config([*SLOW, "num_worlds=256", "predictor=filter"])
    priors, practice = derive_priors(Launches.of(config), config.predictor.fit), flown(config)
    apex = practice.predictor_target[practice.predictor_valid][:, :3]
    away = [abs(float(apex.mean(0)[0]) - known.apex.mean[0]) for known in (priors, PredictorPriors())]
    assert away[0] < 0.1 < away[1]
    errors = []
    for known in (priors, PredictorPriors()):
        config.predictor.priors = known
        network = make_predictor(config.predictor)
        torch.nn.init.zeros_(network.layers[-1].weight)  # type: ignore[index, union-attr]
        torch.nn.init.zeros_(network.layers[-1].bias)  # type: ignore[index, union-attr]
        with torch.no_grad():
            found = network(practice.predictor_input)[practice.predictor_valid][:, :3]
        errors.append(float((found - apex).square().sum(1).mean().sqrt()))
    assert errors[0] < errors[1]


def test_saved_weights_keep_theirs_when_the_serve_changes() -> None:
    saved = upgrade_config(to_dict(load_train_config(SLOW)), 1)  # of a version that had constants
    assert saved["predictor"]["priors"] == to_dict(PredictorPriors())
    policy = load_policy("pretrained/pace")
    assert policy.config.predictor.priors == PredictorPriors()
    assert override_task(policy.config, SLOW).predictor == policy.config.predictor
