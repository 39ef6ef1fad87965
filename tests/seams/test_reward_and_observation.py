"""A reward term and observations from outside: they train, and the policy is played without the term's module."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from pace.config import plugins
from pace.config.base import ConfigError
from pace.config.training import load_train_config
from pace.evaluation.__main__ import main as evaluate
from pace.evaluation.serves import evaluate_row
from pace.rl.policies import load_policy
from pace.rl.train import main as train
from pace.runs.checkpoint import CheckpointError
from pace.runs.metrics import read_metrics
from pace.runs.queue import Run, check_settings
from pace.task.observations import POLICY
from pace.task.rewards import TERMS
from pace.viewer.playback import Show
from tests.helpers.envs import make_env
from tests.helpers.outside import SMALL, command, python, stranger, write_module
from tests.helpers.saved import save_run

TERM = """
    from pace.task.rewards import term

    def still_joints(state, params):
        return -params["gain"] * state.robot.joint_velocity.square().sum(1)

    @term("height")
    def paddle_up(state, params):
        return (state.robot.paddle_position[:, 2] > params["height"]).float()
"""
SIGHT = """
    from pace.task.observations import ActorObservation, CriticObservation

    ball_over_table = ActorObservation(1, lambda signals: signals.sensing.ball_position[:, 2:] - 0.76)
    true_speed = CriticObservation(1, lambda state: state.ball.velocity.norm(dim=1, keepdim=True))
    a_number = 3
"""
MINE = "+reward.terms.mine={weight: 2.0, params: {gain: 0.5}, function: outside_term:still_joints}"
OBSERVED = "[heading, previous_action, outside_sight:ball_over_table]"


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "outside"
    write_module(path, "outside_term", TERM)
    write_module(path, "outside_sight", SIGHT)
    with stranger(path):
        yield path


@pytest.mark.slow
def test_a_term_given_by_its_path_trains_and_the_policy_plays_without_it(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert command(train, f"out={run}", MINE, *SMALL) == 0
    paid = read_metrics(run / "metrics.csv")["reward/mine"]
    assert len(paid) == 2
    assert max(paid) < 0
    with stranger():  # who has not got the module
        policy = load_policy(run)
        assert policy.config.reward.terms["mine"].function == "outside_term:still_joints"
        assert policy.config.plugins == ["outside_term"]
        env = policy.make_env(2, "cpu", 1, ["engine.threads=1"])
        env.advance(policy(env.policy_observation))
        assert env.reward.tolist() == [0.0, 0.0]
        assert float(env.pop_statistics()["reward_sum"]) == 0.0
        assert evaluate_row(policy, "short", 4, 4, "cpu", overrides=["engine.threads=1"]).summary["serves"] == 4
        Show(policy).advance(0.1)
        with pytest.raises(ConfigError, match=r"reward.terms.mine.function: .*plugins=\[outside_term\]"):
            policy.make_env(2, "cpu", rewards=True)


def test_the_other_ways_to_name_a_term(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"unknown reward term 'reward.terms.paddle_up'"):
        make_env(2, "native", "cpu", overrides=["+reward.terms.paddle_up={weight: 1.0}"])
    by_name = "+reward.terms.paddle_up={weight: 1.0, params: {height: 0.2}}"
    again = "+reward.terms.higher={weight: 1.0, params: {height: 9.0}, function: outside_term:paddle_up}"
    twice = "+reward.terms.later={weight: 1.0, params: {sigma: 0.3}, function: arrival}"
    env = make_env(2, "native", "cpu", overrides=["plugins=[outside_term]", by_name, again, twice, "engine.threads=1"])
    env.advance(torch.zeros(2, 21))
    values = dict(zip(env.rewards.names, env.rewards.values[:, 0].tolist(), strict=True))
    assert (values["paddle_up"], values["higher"]) == (1.0, 0.0)
    wrong = again.replace("height", "hight")
    with pytest.raises(ConfigError, match=r"reward.terms.higher.params misses \['height'\]"):
        make_env(2, "native", "cpu", overrides=[wrong])


def test_a_term_may_not_take_the_name_of_another(folder: Path) -> None:
    write_module(folder, "outside_twin", "from pace.task.rewards import term\n@term()\ndef fall(state, params): ...\n")
    with pytest.raises(ConfigError, match="there is a reward term 'fall' already"):
        plugins.use(["outside_twin"])


def test_an_installed_entry_point_needs_no_naming(folder: Path) -> None:
    info = folder / "outside-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: outside\nVersion: 1.0\n")
    terms = "[pace.reward_terms]\ncalm = outside_term:still_joints\n"
    (info / "entry_points.txt").write_text(f"{terms}[pace.observations]\nover = outside_sight:ball_over_table\n")
    assert TERMS["calm"].params is None
    assert POLICY["over"].size == 1
    env = make_env(2, "native", "cpu", overrides=["observation.policy=[heading,over]", "engine.threads=1"])
    assert env.policy_observation.shape == (2, 15)
    with pytest.raises(ConfigError, match=r"known: .*, calm, "):
        TERMS["calmer"]


@pytest.mark.slow
def test_observations_from_outside_train_and_need_their_module_again(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    critic = "observation.critic=[apex, outside_sight:true_speed]"
    assert command(train, f"out={run}", f"observation.policy={OBSERVED}", critic, *SMALL) == 0
    table = ("rows=[short]", "serves=4", "num_worlds=4", "engine.threads=1", "progress=false")
    table += ("physics_dt=0.01", "first_ball=[]")
    with stranger(folder):
        with pytest.raises(CheckpointError, match=r"ball_over_table'.*plugins=\[outside_sight\]"):
            load_policy(run)
        assert command(evaluate, str(run), f"out={tmp_path / 'without'}", *table) == 1
        assert command(evaluate, str(run), f"out={tmp_path / 'with'}", "plugins=[outside_sight]", *table) == 0
        policy = load_policy(run)
        env = policy.make_env(2, "cpu", 1, ["engine.threads=1"])
        column = env.policy_layout["outside_sight:ball_over_table"]
        frame = env.policy_observation.view(2, 5, -1)[:, -1, column]
        torch.testing.assert_close(frame, env.sensing.ball_position[:, 2:] - 0.76)


@pytest.mark.parametrize(
    ("group", "name", "words"),
    [
        ("policy", "outside_sight:true_speed", "must be of type ActorObservation, .*privileged: for the critic alone"),
        ("critic", "outside_sight:ball_over_table", "must be of type CriticObservation"),
        ("policy", "outside_sight:a_number", "must be of type ActorObservation, not int"),
        ("policy", "outside_sight:nothing", "module outside_sight has no nothing"),
        ("policy", "no_such_module:x", "no_such_module cannot be imported"),
    ],
)
def test_the_type_says_who_may_see_it(folder: Path, group: str, name: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_env(2, "native", "cpu", overrides=[f"observation.{group}=[heading,'{name}']"])


@pytest.mark.long
def test_several_processes_and_a_resumed_run_know_the_module(folder: Path, tmp_path: Path) -> None:
    """The module lies in the working folder; each process of the run imports it."""
    arguments = [argument for argument in SMALL if not argument.startswith("samples")]
    made = python(folder, "pace.rl.train", f"out={tmp_path / 'run'}", MINE, "samples=64", "processes=2", *arguments)
    assert made.returncode == 0, made.stderr
    limits = (f"resume={tmp_path / 'run'}", "samples=128", "progress=false")
    refused = python(folder, "pace.rl.train", *limits)
    assert refused.returncode == 2
    assert "plugins=[outside_term]" in refused.stderr
    resumed = python(folder, "pace.rl.train", *limits, "plugins=[outside_term]")
    assert resumed.returncode == 0, resumed.stderr
    assert read_metrics(tmp_path / "run" / "metrics.csv")["update"] == [1, 2, 3, 4]


def test_a_stage_of_the_curriculum_may_bring_one(folder: Path) -> None:
    stage = "curriculum=[{samples: 9, task: ['reward.terms.fall.function=outside_term:still_joints']}]"
    assert load_train_config([stage]).plugins == ["outside_term"]


def test_an_ablation_names_it_again_when_it_resumes_a_run(folder: Path, tmp_path: Path) -> None:
    run = check_settings(Run(tmp_path / "run", (MINE, "seed=1"), 64.0))
    assert run.plugins == ("outside_term",)
    assert MINE in run.arguments()
    save_run(tmp_path / "run")
    assert run.arguments()[1] == "plugins=[outside_term]"
