"""``python -m pace.studies.ablate``: what its experiments take away, its numbers over seeds, and a tiny real
ablation."""

from __future__ import annotations

import sys
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from pace.config.base import ConfigError, compose, parse, to_dict
from pace.config.commands import AblateConfig
from pace.config.training import TrainConfig, load_train_config
from pace.runs.metrics import Curve, Milestone, read_metrics
from pace.studies.ablate import main
from pace.studies.ablation import needed, over_seeds, planned_runs, summary

FIGURE = "some.png"
TINY = (
    "num_worlds=8", "algo.steps=12", "algo.actor_hidden=[16]", "algo.critic_hidden=[16]",
    "predictor.batches_per_update=1", "tensorboard=false",
)  # fmt: skip
UPDATE = 8 * 12


@pytest.fixture
def ablate(monkeypatch: pytest.MonkeyPatch):
    """Run the command with arguments, in this process; returns its exit status."""

    def run(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["ablate", *arguments])
        return main()

    return run


@lru_cache
def experiment(name: str) -> TrainConfig:
    return load_train_config([f"experiment={name}" if name == "paper" else f"experiment=ablation/{name}"])


def changed_parts(name: str) -> set[str]:
    baseline, other = to_dict(experiment("baseline")), to_dict(experiment(name))
    return {key for key in baseline if baseline[key] != other[key]} - {"name"}


@pytest.mark.parametrize(
    ("name", "silenced"),
    [
        ("no_hit_guidance", {"paddle_to_target", "base_to_target", "base_velocity", "arrival"}),
        ("no_return_guidance", {"predicted_landing", "predicted_net_height", "return_velocity"}),
    ],
)
def test_guidance_is_taken_away_and_nothing_else(name: str, silenced: set[str]) -> None:
    baseline, less = experiment("baseline").reward, experiment(name).reward
    assert changed_parts(name) == {"reward"}
    assert {term for term in less.terms if less.terms[term].weight == 0} == silenced
    for term in set(baseline.terms) - silenced - {"success"}:
        assert less.terms[term] == baseline.terms[term]
    assert less.terms["success"].weight == baseline.terms["success"].weight
    at_hit = less.terms["success"].params["at_hit"]
    assert at_hit == (0.0 if name == "no_return_guidance" else baseline.terms["success"].params["at_hit"])


def test_without_a_predictor_the_actor_has_no_predicted_quantity() -> None:
    assert changed_parts("no_predictor") == {"predictor", "observation"}
    baseline, less = experiment("baseline"), experiment("no_predictor")
    assert not less.predictor.enabled
    gone = {"predicted_apex", "predicted_base_shift", "predicted_time"}
    assert less.observation.policy == [name for name in baseline.observation.policy if name not in gone]
    assert less.observation.critic == baseline.observation.critic


def test_paper_reward_is_that_of_the_paper_in_our_scale() -> None:
    assert changed_parts("paper_reward") == {"reward"}
    ours, paper, mixed = experiment("baseline"), experiment("paper"), experiment("paper_reward")
    assert mixed.reward.terms == paper.reward.terms
    assert mixed.reward.scale == ours.reward.scale != paper.reward.scale


def line(end: float, slope: float) -> Curve:
    """A curve whose hits rise from 0 by ``slope`` a million, to ``end`` millions."""
    samples = np.linspace(0.1, end, round(10 * end)) * 1e6
    zero = np.zeros(len(samples))
    return Curve(samples, samples / 1e6, {"hits": slope * samples / 1e6, "returns": zero, "falls": zero})


def test_median_and_range_over_seeds() -> None:
    half = Milestone("hits", 0.5)
    seeds = [line(10.0, slope) for slope in (0.1, 0.25, 0.05)]
    assert needed(seeds, half) == "5.0 (2.0 to 10.0)"
    assert needed([*seeds[:2], line(10.0, 0.01)], half) == "5.0 (2 of 3 seeds)"
    assert needed([seeds[0], line(10.0, 0.01), line(10.0, 0.01)], half) == "- (1 of 3 seeds)"
    assert needed([line(10.0, 0.01)], half) == "-"
    assert needed(seeds[:1], half) == "5.0"


def test_the_table_has_what_was_reached_and_rates_where_all_runs_have_been() -> None:
    table = summary({"quick": [line(10.0, 0.1), line(10.0, 0.06)], "slow": [line(5.0, 0.02)]})
    head, _, quick, slow = table.splitlines()
    wanted = ("hits 10 %", "hits 50 %", "hits 90 %", "hits, %, at 5.0 M")
    columns = head.split(" | ")
    assert [name in columns for name in wanted] == [True] * 4
    assert "returns 10 %" not in columns
    assert quick.split(" | ")[columns.index("hits 50 %")] == "6.7 (5.0 to 8.4)"
    assert quick.split(" | ")[columns.index("hits, %, at 5.0 M")] == "40.0 (30.0 to 50.0)"
    assert slow.split(" | ")[columns.index("hits, %, at 5.0 M")] == "10.0"
    assert quick.split(" | ")[-1].strip(" |") == "16,667"  # a million a minute


def test_seeds_are_compared_where_all_of_them_have_been() -> None:
    samples, values = over_seeds([line(4.0, 0.1), line(2.0, 0.2)], "hits")
    assert samples[-1] == pytest.approx(2e6)
    np.testing.assert_allclose(values, [0.1 * samples / 1e6, 0.2 * samples / 1e6])


def test_every_experiment_gets_every_seed() -> None:
    config = parse(
        compose("ablate", ["experiments=[ablation/baseline,ablation/paper_reward]", "seeds=[4,5]"]), AblateConfig
    )
    runs = planned_runs(config)
    assert [run.name for run in runs] == [
        "baseline_seed4",
        "paper_reward_seed4",
        "baseline_seed5",
        "paper_reward_seed5",
    ]
    assert runs[3].overrides == ("experiment=ablation/paper_reward", "seed=5")
    for wrong in ("seeds=[]", "seeds=[1,1]", "jobs=0", "samples=0", "experiments=[]", "figure=a.svg"):
        with pytest.raises(ConfigError):
            parse(compose("ablate", [wrong]), AblateConfig)


@pytest.mark.long
def test_a_real_ablation_and_its_second_call(ablate, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    common = (
        "experiments=[ablation/no_predictor,ablation/paper_reward]", "seeds=[3]", f"out={out}",
        f"window={UPDATE}", f"figure={FIGURE}", "progress=false", *TINY,
    )  # fmt: skip
    assert ablate(f"samples={2 * UPDATE}", "jobs=2", *common) == 0
    printed = capsys.readouterr().out
    assert "| M control steps to | " in printed
    assert "| `no_predictor` | " in printed
    assert f"wrote {out / FIGURE}" in printed
    for name in ("no_predictor", "paper_reward"):
        assert read_metrics(out / f"{name}_seed3.csv")["samples"] == [2 * UPDATE]
        assert f"{name}_seed3: finished" in printed
    (out / FIGURE).unlink()
    assert ablate(f"samples={2 * UPDATE}", *common) == 0
    assert "finished after" not in capsys.readouterr().out  # nothing was trained again
    assert (out / FIGURE).stat().st_size > 10_000
    assert ablate(f"samples={2 * UPDATE}", "algo.gamma=0.9", *common) == 2
    assert "trained with algo.gamma 0.98, and 0.9 is asked for" in capsys.readouterr().err


def test_nothing_to_draw_and_unknown_experiments_are_one_line(
    ablate, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ablate("train=false", f"out={tmp_path}") == 1
    assert "nothing to draw" in capsys.readouterr().err
    assert ablate("experiments=[no_such]", f"out={tmp_path}") == 2
    assert "no_such" in capsys.readouterr().err
