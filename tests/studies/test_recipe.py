"""docs/results/recipe: every run that its table lists has metrics and a resolved recipe, which can be trained again."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from pace.config.base import compose, parse, to_dict
from pace.config.training import TrainConfig
from pace.rl.train import main as train
from pace.runs.metrics import Milestone, passage, read_curve, read_metrics
from pace.runs.own_files import LIST
from pace.studies import learning_curves
from pace.studies.__main__ import main as studies
from pace.studies.ablation import run_name
from pace.studies.recipe import Tried, draw, listed, table, take_over
from tests.helpers.recipes import FOLDER, RESULTS, recipe, written

GONE = {"return_velocity_first", "campaign_first"}  # a reward term, and an observation, that were replaced
NAMES = sorted(file.stem for file in FOLDER.glob("*.yaml"))


def assert_holds(config: Any, wanted: Any) -> None:
    """Every value of ``wanted`` stands in ``config``, and its reward terms are all that there are."""
    if isinstance(wanted, dict):
        for key, value in wanted.items():
            assert_holds(config[key], value)
        assert "terms" not in wanted or set(config["terms"]) == set(wanted["terms"])
    elif isinstance(wanted, list):
        assert len(config) == len(wanted)
        for value, one in zip(config, wanted, strict=True):
            assert_holds(value, one)
    else:
        assert config == wanted


def test_every_run_has_metrics_and_a_resolved_recipe() -> None:
    metrics = {file.stem for file in FOLDER.glob("*_seed*.csv")}
    runs = listed(FOLDER)
    assert {tried.file.stem for tried in runs} <= metrics
    recipes = {name.rpartition("_seed")[0] for name in metrics}
    assert {tried.recipe for tried in runs} >= GONE
    assert recipes - set(NAMES) == GONE
    assert set(NAMES) - recipes == {"kl_stays"}  # what kl_stays_stance is made of


@pytest.mark.parametrize("name", NAMES)
def test_a_recipe_is_whole_and_of_this_version(name: str) -> None:
    config = recipe(name)
    assert config.name == name
    plain = to_dict(config)
    assert_holds(plain, written(name))
    run_keys = set(plain) - set(written(name))
    assert run_keys == {
        "device", "processes", "seed", "out", "resume", "init_from", "predictor_from", "checkpoint_minutes",
        "tensorboard", "logger", "progress", "plugins", "plan", "judge",
    }  # fmt: skip
    assert set(plain["ball"]) - set(written(name)["ball"]) == {"air"}  # of which these balls use nothing


@pytest.mark.parametrize("name", NAMES)
def test_a_recipe_has_the_ball_that_it_was_trained_with(name: str) -> None:
    """The first reading of rubber: no springing back, constant coefficients of the air, sliding friction 0.25."""
    ball = recipe(name).ball
    assert (ball.name, ball.drag_coefficient, ball.table_drag, ball.table_lift) == (
        "rubber_first_reading",
        0.5,
        0.0,
        0.0,
    )
    assert (ball.paddle_friction, ball.paddle_tangential_restitution, ball.paddle_drilling_loss) == (0.25, 0.0, 0.0)


@pytest.mark.parametrize("name", ["steps_12", "campaign_wide", "no_hit_guidance"])
def test_a_recipe_can_be_composed_for_training(name: str) -> None:
    composed = parse(compose("train", [f"+recipe={name}", f"hydra.searchpath=[{RESULTS}]"]), TrainConfig)
    assert composed == recipe(name)


def test_a_recipe_can_be_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = ["num_worlds=4", "algo.actor_hidden=[8]", "algo.critic_hidden=[8]", "engine.threads=1", "processes=1"]
    limits = ["samples=16", "progress=false", "tensorboard=false", f"out={tmp_path / 'run'}"]
    monkeypatch.setattr(sys, "argv", ["train", "--config-dir", str(RESULTS), "+recipe=swing", *small, *limits])
    assert train() == 0
    assert "reward/swing" in read_metrics(tmp_path / "run" / "metrics.csv")


def test_recipes_are_those_of_their_time_with_one_change() -> None:
    first, worlds = recipe("steps_12"), recipe("worlds_512")
    assert (first.num_worlds, first.algo.steps, first.algo.kl_target[0].value) == (1024, 12, 0.025)
    assert first.reward.terms["return_velocity"].weight == 0
    assert worlds.num_worlds == 512
    assert worlds.algo == first.algo
    late = recipe("return_velocity_late")
    assert (late.algo.steps, late.algo.std[0].value, late.reward.terms["return_velocity"].weight) == (4, 0.6, 400.0)


def test_a_milestone_of_the_table() -> None:
    found = passage(read_curve(FOLDER / "schedules_seed2.csv"), Milestone("hits", 0.5))
    assert found is not None
    assert found.samples == pytest.approx(6.1e6, abs=0.05e6)
    assert found.minutes == pytest.approx(18, abs=0.5)


def write_metrics(file: Path, slope: float) -> None:
    """Metrics of 40 rows of 0.1 M control steps and a minute, in which hits rise by ``slope`` a million."""
    file.parent.mkdir(parents=True, exist_ok=True)
    names = ("samples", "wall_s", "hit_rate", "success_rate", "fall_rate", "hit", "succ", "fallps")
    rows = [(1e5 * u, 60 * u, slope * u / 10, 0.0, 0.05, slope * u / 10, 0.0, 0.05) for u in range(1, 41)]
    lines = [",".join(names), *(",".join(str(value) for value in row) for row in rows)]
    file.write_text("\n".join(lines) + "\n")


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A folder of results with two runs, of which the second starts from the first, and a prototype."""
    folder = tmp_path / "results"
    write_metrics(folder / "recipe" / f"{run_name('first', 1)}.csv", 0.21)
    write_metrics(folder / "recipe" / "return_velocity_seed1.csv", 0.41)
    write_metrics(folder / "learning" / "prototype.csv", 0.11)
    (folder / "recipe" / "runs.csv").write_text(
        "recipe,seed,run,from_samples,from_minutes,change\n"
        'first,1,a1,0,0,"nothing, at first"\n'
        "return_velocity,1,b1,1000000,5,more\n"
    )
    return folder


def test_the_table_counts_from_the_start_of_the_run_that_came_before(results: Path) -> None:
    curves = {tried: tried.curve() for tried in listed(results / "recipe")}
    head, _, first, second = table(curves).splitlines()
    column = head.split(" | ").index("hits 50 %")
    assert first.split(" | ")[:4] == ["| first", "1", "nothing, at first", "4.0"]
    assert first.split(" | ")[column] == "2.5 (25)"  # a mean over the last 0.25 M lags by 0.1 M
    assert second.split(" | ")[column] == "2.4 (19)"
    assert draw(curves, results / "recipe.png").stat().st_size > 10_000


def test_metrics_of_new_runs_are_taken_over(results: Path, tmp_path: Path) -> None:
    write_metrics(tmp_path / "runs" / "b1" / "metrics.csv", 0.6)
    runs: list[Tried] = listed(results / "recipe")
    take_over(runs, tmp_path / "runs")
    assert len(read_metrics(runs[0].file)["samples"]) == 40  # not there, left as it was
    taken = read_metrics(runs[1].file)
    assert taken["samples"][-1] == 4e6
    assert len(taken["samples"]) == 10  # four rows in one


def test_learning_curves_of_seeds_and_prototype(results: Path) -> None:
    curves = learning_curves.read(results)
    assert list(curves) == ["seed1", "prototype"]
    rows = [line.split(" | ") for line in learning_curves.table(curves).splitlines()]
    assert ["| hits 10 %", "0.4", "1.1 |"] in rows
    assert learning_curves.draw(curves, results / "learning.png").stat().st_size > 10_000


def test_the_command_prints_the_tables_of_the_pages(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["studies", "recipe", "learning", f"out={tmp_path}"])
    assert studies() == 0
    printed = set(capsys.readouterr().out.splitlines())
    page = (RESULTS / "recipe.md").read_text().splitlines()
    assert {line for line in page if line.startswith(("| steps_12 |", "| campaign |"))} <= printed
    assert {file.name for file in tmp_path.iterdir()} == {"recipe.png", "learning.png", LIST}
