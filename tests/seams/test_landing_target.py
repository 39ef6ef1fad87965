"""The landing target belongs to the task: a policy that was trained without a term for it can be evaluated."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from pace.config.base import ConfigError, to_dict
from pace.config.training import load_train_config
from pace.config.upgrade import LANDING_TARGET, upgrade_config
from pace.evaluation.__main__ import main as evaluate
from pace.evaluation.records import COLUMNS
from pace.evaluation.serves import evaluate_row
from pace.rl.policies import load_policy
from pace.rl.train import main as train
from pace.task.outcome import Outcome
from tests.helpers.outside import SMALL, command


@pytest.mark.slow
def test_a_policy_trained_without_the_term_is_evaluated(tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "table"
    assert command(train, f"out={run}", "~reward.terms.predicted_landing", *SMALL) == 0
    table = ("rows=[short]", "serves=4", "num_worlds=4", "engine.threads=1", "progress=false", "physics_dt=0.01")
    table += ("first_ball=[]",)
    assert command(evaluate, str(run), f"out={out}", *table) == 0
    assert json.loads((out / "evaluation.json").read_text())["rows"][0]["serves"] == 4
    assert (out / "landing_map.png").exists()


@pytest.mark.slow
def test_the_table_measures_from_the_target_of_the_task() -> None:
    policy = load_policy("pretrained/pace")
    assert policy.config.landing_target == list(LANDING_TARGET)
    rows = [
        evaluate_row(policy, "short", 64, 16, "cpu", overrides=[f"landing_target=[{x},0.1]", "engine.threads=1"])
        for x in (1.15, 0.4)
    ]
    landed = rows[0].records[rows[0].records[:, COLUMNS.index("outcome")] == Outcome.SUCCESS]
    assert len(landed) > 0
    places = landed[:, [COLUMNS.index("landing_x"), COLUMNS.index("landing_y")]]
    for row, x in zip(rows, (1.15, 0.4), strict=True):
        expected = (places - torch.tensor([x, 0.1])).norm(dim=1).mean().item()
        assert row.summary["landing_error"] == pytest.approx(expected, rel=1e-5)


def test_saved_configurations_have_it_from_their_term_or_the_default() -> None:
    config = to_dict(load_train_config())
    del config["landing_target"]
    config["reward"]["terms"]["predicted_landing"]["params"] = {"offset": 3.0, "x": 0.9, "y": 0.2}
    upgraded = upgrade_config(config, 1)
    assert upgraded["landing_target"] == [0.9, 0.2]
    assert upgraded["reward"]["terms"]["predicted_landing"]["params"] == {"offset": 3.0}
    del config["reward"]["terms"]["predicted_landing"]
    assert upgrade_config(config, 1)["landing_target"] == list(LANDING_TARGET)
    assert upgrade_config(upgraded, 1) == upgraded
    with pytest.raises(ConfigError, match="landing_target needs two numbers"):
        load_train_config(["landing_target=[1.0]"])
