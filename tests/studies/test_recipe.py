"""docs/recipe: every run that its table lists has metrics, and an experiment that composes."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from pace.config.base import config_dir
from pace.config.training import load_train_config
from pace.runs.metrics import Milestone, passage, read_curve
from pace.studies.ablation import run_name

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "recipe"
GONE = {"return_velocity_first", "campaign_first"}  # a reward term, and an observation, that were replaced


def listed() -> list[dict[str, str]]:
    with (FOLDER / "runs.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_run_has_metrics_and_an_experiment() -> None:
    names = {f"{run_name(row['experiment'], int(row['seed']))}.csv" for row in listed()}
    assert names | {"runs.csv"} == {file.name for file in FOLDER.glob("*.csv")}
    experiments = {file.stem for file in (config_dir() / "experiment").glob("*.yaml")}
    assert {row["experiment"] for row in listed()} - experiments == GONE


def test_experiments_are_the_recipe_of_their_time_with_one_change() -> None:
    first, worlds = (load_train_config([f"experiment={name}"]) for name in ("steps_12", "worlds_512"))
    assert (first.num_worlds, first.algo.steps, first.algo.kl_target[0].value) == (1024, 12, 0.025)
    assert first.reward.terms["return_velocity"].weight == 0
    assert worlds.num_worlds == 512
    assert worlds.algo == first.algo
    late = load_train_config(["experiment=return_velocity_late"])
    assert (late.algo.steps, late.algo.std[0].value, late.reward.terms["return_velocity"].weight) == (4, 0.6, 400.0)


def test_a_milestone_of_the_table() -> None:
    found = passage(read_curve(FOLDER / "schedules_seed2.csv"), Milestone("hits", 0.5))
    assert found is not None
    assert found.samples == pytest.approx(6.1e6, abs=0.05e6)
    assert found.minutes == pytest.approx(18, abs=0.5)
