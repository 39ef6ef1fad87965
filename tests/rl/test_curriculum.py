"""Tasks that follow one another in a run: which when, and a resume that goes on exactly."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pace.config.base import ConfigError
from pace.config.overrides import stage_tasks
from pace.config.schedules import START, Position, Stage
from pace.config.training import TrainConfig, load_train_config
from pace.rl.curriculum import Curriculum
from pace.rl.policies import load_policy
from pace.rl.train import main
from pace.runs.checkpoint import load_checkpoint
from pace.runs.metrics import read_metrics
from tests.helpers.algo import IN_SAMPLES
from tests.helpers.fakes import config

WORLDS, STEPS = 8, 6
UPDATE = WORLDS * STEPS
SMALL = [
    f"num_worlds={WORLDS}", f"algo.steps={STEPS}", "algo.actor_hidden=[16]", "algo.critic_hidden=[16]",
    "progress=false", "tensorboard=false", "processes=1", "engine.threads=1", *IN_SAMPLES,
]  # fmt: skip
WIDER = f"curriculum=[{{samples: {2 * UPDATE}, task: ['sensing=wide', 'serve.serves_per_episode=9']}}]"


def staged() -> TrainConfig:
    stages = [Stage(1e6, ["sensing=paper", "ball=venue"]), Stage(3e6, ["sensing.mocap_delay=[0.0,0.05]"])]
    return replace(config("sensing=clean", "randomization=none"), curriculum=stages)  # type: ignore[return-value]


def test_each_stage_changes_the_task_of_the_one_before() -> None:
    first, second, third = stage_tasks(staged())
    assert (first.sensing.name, first.ball.name, first.sensing.mocap_delay) == ("clean", "rubber", [0.0, 0.0])
    assert (second.sensing.name, second.ball.name, second.sensing.mocap_delay) == ("paper", "venue", [0.004, 0.010])
    assert (third.sensing.name, third.ball.name, third.sensing.mocap_delay) == ("paper", "venue", [0.0, 0.05])


def test_the_generalists_stages_are_tasks() -> None:
    tasks = stage_tasks(load_train_config(["experiment=generalist"]))
    assert [task.serve.name for task in tasks] == [*4 * ["train"], "machine"]
    assert [task.serve.pause[1] for task in tasks] == [0.0, *3 * [1.0], 3.0]
    assert [task.serve.first_pause[1] for task in tasks] == [0.0, *3 * [1.5], 4.0]
    assert [task.sensing.name for task in tasks] == [*3 * ["paper"], *2 * ["mocap"]]
    assert [task.reward.terms["ready_stance"].weight for task in tasks] == [5.0, *4 * [10.0]]
    assert [task.randomization.name for task in tasks] == [*2 * ["moderate"], *3 * ["wide"]]
    assert [task.randomization.preset_share for task in tasks] == [*2 * [0.0], *3 * [0.5]]
    assert [task.randomization.trunk_mass for task in tasks] == [*3 * [[-2.0, 2.0]], *2 * [[-4.0, 6.0]]]
    assert [task.randomization.actuator_delay[1] for task in tasks] == [*3 * [0.006], 0.015, 0.025]
    assert [task.serve.serves_per_episode for task in tasks] == [*4 * [5], 20]
    assert (tasks[-1].robot.name, tasks[-1].ball.name, tasks[-1].serve.topspin) == ("t1", "rubber", [-60.0, 60.0])


def test_worlds_are_made_when_a_stage_begins() -> None:
    made: list[tuple[str, int]] = []

    def make(task: TrainConfig, stage: int) -> str:
        made.append((task.sensing.name, stage))
        return f"worlds {stage}"

    curriculum = Curriculum(staged(), make, START)
    assert [curriculum.move_on(Position(samples)) for samples in (0.0, 0.9e6, 1e6, 2e6, 3.1e6, 9e6)] == [
        False, False, True, False, True, False
    ]  # fmt: skip
    assert made == [("clean", 0), ("paper", 1), ("paper", 2)]
    assert curriculum.worlds == "worlds 2"
    assert Curriculum(staged(), make, Position(1e6)).worlds == "worlds 1"  # a run that goes on there


def train(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["train", *arguments])
    return main()


@pytest.mark.slow
def test_a_run_changes_its_task_and_resumes_exactly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, updates in (("whole", 4), ("parts", 2)):  # the parts meet where the stage begins
        samples, folder = f"samples={updates * UPDATE}", f"out={tmp_path / name}"
        assert train(monkeypatch, *SMALL, WIDER, samples, folder) == 0
    assert train(monkeypatch, f"resume={tmp_path / 'parts'}", f"samples={4 * UPDATE}") == 0
    whole, parts = load_checkpoint(tmp_path / "whole"), load_checkpoint(tmp_path / "parts")
    for name, tensor in whole.weights["agent"].items():
        assert torch.equal(tensor, parts.weights["agent"][name]), name
    assert whole.training is not None
    assert parts.training is not None
    delay = [run.training["processes"][0]["env"]["sensing._delay"] for run in (whole, parts)]  # type: ignore[index]
    assert torch.equal(*delay)
    assert float(delay[0].max()) > 0.5  # control steps: later than the paper's
    assert read_metrics(tmp_path / "whole" / "metrics.csv")["stage"] == [0, 0, 1, 1]
    assert load_policy(tmp_path / "whole").config.sensing.name == "wide"  # what it was trained for last


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ("[{samples: 1e6, task: ['sensing=blind']}]", "from 1e+06 control steps on"),
        ("[{samples: 1e6, task: ['algo.gamma=0.9']}]", "'algo.gamma' cannot change"),
        ("[{samples: 2e6, task: []}, {samples: 1e6, task: []}]", "one after another"),
        ("[{samples: 0, task: ['sensing=wide']}]", "a stage at 0 is the task itself"),
        ("[{samples: 1e6}]", "task"),
    ],
)
def test_a_wrong_stage_is_one_line_before_anything_is_played(
    stages: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    assert train(monkeypatch, *SMALL, f"curriculum={stages}", f"out={tmp_path / 'run'}") == 2
    lines = [line for line in capfd.readouterr().err.splitlines() if not line.startswith("Warp")]
    assert len(lines) == 1
    assert message in lines[0]
    assert not (tmp_path / "run").exists()


def test_stages_are_checked() -> None:
    run = staged()
    run.curriculum[1].task = ["randomization.no_such_thing=1"]
    with pytest.raises(ConfigError, match="no_such_thing"):
        stage_tasks(run)
