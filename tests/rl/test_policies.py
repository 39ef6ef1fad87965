"""A saved policy: what it computes, the task that comes with it, and one clear error for each bad input."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path

import pytest
import torch

import pace.rl
from pace.config.base import ConfigError, to_dict
from pace.config.overrides import override_task
from pace.config.training import load_train_config
from pace.rl import policies as loading
from pace.rl.policies import built_in_policy, load_policy, locate, policy_size
from pace.rl.start import other_choices
from pace.runs.checkpoint import META, WEIGHTS, CheckpointError, load_checkpoint
from pace.runs.checkpoint_folders import list_checkpoints
from tests.helpers.saved import make_agent, make_config, save_run


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return save_run(tmp_path / "run")


def test_it_is_the_mean_of_the_trained_actor(run: Path) -> None:
    policy, agent = pace.rl.load_policy(run), make_agent(make_config())
    raw = 3.0 * torch.randn(7, policy_size(policy.config))
    expected = agent.actor(agent.policy_norm(raw))[0]
    assert torch.equal(policy(raw), expected)
    assert torch.equal(policy(raw), policy(raw))
    assert policy(raw).shape == (7, 21)
    assert not policy(raw).requires_grad
    assert policy.counters["updates"] == 3


def test_run_checkpoint_file_and_pretrained(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    newest = list_checkpoints(run)[-1]
    for path in (run, newest, newest / META, newest / WEIGHTS):
        assert load_policy(path).source == str(newest)
    monkeypatch.setattr(loading, "config_dir", lambda: newest.parent / "configs")
    assert load_policy(newest.name).source == str(newest)


def test_the_task_comes_with_it(run: Path) -> None:
    policy = load_policy(run)
    env = policy.make_env(2, "cpu", 3, ["serve=short", "ball=paper", "engine.physics_dt=0.02"])
    assert env.policy_observation.shape == (2, policy_size(policy.config))
    assert env.actor.predictor is policy.predictor
    assert (env.config.serve.name, env.config.ball.name, env.worlds.engine.substeps) == ("short", "paper", 1)
    assert env.config.reward.scale == policy.config.reward.scale == 0.125  # saved, not that of configs/
    assert policy(env.policy_observation).shape == (2, 21)
    assert float(env.worlds.ball.velocity[:, 0].min()) >= -5.7


def test_overrides_change_a_copy() -> None:
    config = load_train_config(["engine.solver_iterations=17"])
    changed = override_task(config, ["engine=mjwarp", "ball=paper", "ball=venue", "sensing.mocap_delay=[0.02,0.03]"])
    assert (changed.engine.name, changed.engine.solver_iterations) == ("mjwarp", 17)
    assert changed.ball.name == "venue"
    assert changed.sensing.mocap_delay == [0.02, 0.03]
    assert (config.engine.name, config.ball.name) == ("auto", "rubber")
    assert to_dict(override_task(config, [])) == to_dict(config)


def test_a_saved_robot_keeps_its_motors_until_it_gets_new_ones() -> None:
    saved = load_train_config(["robot.stall_ratio=0"])
    assert override_task(saved, []).robot.stall_ratio == 0
    assert override_task(saved, ["robot=t1"]).robot.stall_ratio == 2
    assert override_task(saved, ["robot.stall_ratio=3", "robot=t1"]).robot.stall_ratio == 3


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("ball", "not of the form key=value"),
        ("ball=wood", "paper.*rubber"),
        ("algo=paper", "'algo' cannot change"),
        ("observation.policy_history=2", "cannot change"),
        ("engine.speed=2", "speed"),
        ("engine.physics_dt=fast", "physics_dt"),
        ("engine=bullet", "auto, native or mjwarp"),
    ],
)
def test_a_wrong_override_is_one_error(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        override_task(load_train_config(), [override])


def test_built_ins() -> None:
    zero, random = built_in_policy("zero", 1), built_in_policy("random", 1)
    raw = torch.zeros(4000, 5)
    assert zero(raw).abs().max() == 0
    actions = random(raw)
    assert actions.shape == (4000, 21)
    assert abs(float(actions.std()) - loading.RANDOM_STD) < 0.01
    assert torch.equal(built_in_policy("random", 1)(raw), actions)
    assert not torch.equal(random(raw), actions)
    with pytest.raises(ConfigError, match="zero or random"):
        built_in_policy("best", 1)


def edit_meta(run: Path, **changes: object) -> None:
    file = list_checkpoints(run)[-1] / META
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def test_a_published_policy_is_found_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_policy("campaign").source == load_policy("pretrained/campaign").source
    (tmp_path / "campaign").mkdir()  # what lies here comes first
    with pytest.raises(CheckpointError, match="campaign is neither a run folder nor a checkpoint"):
        load_policy("campaign")
    with pytest.raises(
        CheckpointError, match=r"campagne does not exist; did you mean campaign\? \(pretrained: campaign,"
    ):
        load_policy("campagne")


def test_no_run(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        load_policy(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match="neither a run folder nor a checkpoint"):
        load_policy(tmp_path)
    (tmp_path / "model.pt").write_bytes(b"PK")
    with pytest.raises(CheckpointError, match=r"model\.pt is no file of a checkpoint"):
        load_policy(tmp_path / "model.pt")


def test_another_version(run: Path) -> None:
    config = to_dict(make_config())
    edit_meta(run, config={**config, "spin_model": "none"})
    with pytest.raises(CheckpointError, match=r"another version of pace: .*spin_model"):
        load_policy(run)
    config["observation"]["policy"] = [*config["observation"]["policy"], "umpire"]
    edit_meta(run, config=config)
    with pytest.raises(CheckpointError, match="observes 'umpire'"):
        load_policy(run)
    edit_meta(run, config=7)
    with pytest.raises(CheckpointError, match="another version of pace"):
        load_policy(run)
    edit_meta(run, format=99)
    with pytest.raises(CheckpointError, match="format 99"):
        load_policy(run)


def test_tensors_that_do_not_fit(tmp_path: Path) -> None:
    agent = make_agent(make_config()).state_dict()
    weight = "actor.mlp.layers.0.weight"
    with pytest.raises(CheckpointError, match=r"\(actor\): the tensor layers\.0\.weight is missing"):
        load_policy(save_run(tmp_path / "a", agent={k: v for k, v in agent.items() if k != weight}))
    with pytest.raises(CheckpointError, match=r"\(actor\): the tensor layers\.0\.weight has the shape \(8, 9\)"):
        load_policy(save_run(tmp_path / "b", agent={**agent, weight: torch.zeros(8, 9)}))
    with pytest.raises(CheckpointError, match=r"\(normaliser\): the tensor mean is missing"):
        load_policy(save_run(tmp_path / "c", agent={k: v for k, v in agent.items() if k != "policy_norm.mean"}))
    with pytest.raises(CheckpointError, match="weights of the predictor are missing"):
        load_policy(save_run(tmp_path / "d", without="predictor"))


class Bomb:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.file),)


def test_a_pickle_in_disguise_is_not_run(run: Path, tmp_path: Path) -> None:
    (list_checkpoints(run)[-1] / WEIGHTS).write_bytes(pickle.dumps(Bomb(tmp_path / "boom")))
    with pytest.raises(CheckpointError, match="is broken"):
        load_policy(run)
    assert not (tmp_path / "boom").exists()


def test_what_another_run_was_trained_with_is_named() -> None:
    """The cure of ``init_from=campaign`` in the default task."""
    saved = load_checkpoint(locate("campaign"), weights_only=True).config
    assert other_choices(load_train_config(), saved) == "; it was trained with observation=memory predictor=filter"
    assert other_choices(load_train_config(["observation=memory", "predictor=filter"]), saved) == ""
    mine = to_dict(load_train_config()) | {"algo": saved["algo"] | {"name": "mine", "actor_hidden": [8]}}
    assert other_choices(load_train_config(), mine) == "; it was trained with another algo"
