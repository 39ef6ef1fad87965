"""The configuration: every choice of every group is valid, and wrong input is one error that names the key."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from pace.config.base import ConfigError, compose, config_dir, parse, to_dict
from pace.config.commands import BenchConfig
from pace.config.training import TrainConfig, load_train_config

SCHEMAS = {"train": TrainConfig, "bench": BenchConfig}


def choices() -> list[tuple[str, str]]:
    """Every (group, choice) under configs/; files that begin with _ are parts of others. realities/ holds rows of a
    sweep (tests/evaluation/test_task.py), hydra/ launchers (tests/test_cluster.py)."""
    files = sorted(config_dir().glob("*/**/*.yaml"))
    parts = [f.relative_to(config_dir()).with_suffix("").parts for f in files if not f.stem.startswith("_")]
    return [(group, "/".join(choice)) for group, *choice in parts if group not in ("realities", "hydra")]


@pytest.mark.parametrize(("group", "choice"), choices())
def test_every_choice_composes_and_validates(group: str, choice: str) -> None:
    command = "bench" if group == "bench" else "train"
    config = parse(compose(command, [f"{group}={choice}"]), SCHEMAS[command])
    assert config.substeps * config.engine.physics_dt == pytest.approx(config.robot.control_dt)


@pytest.mark.parametrize("command", sorted(SCHEMAS))
def test_every_command_composes_and_validates(command: str) -> None:
    config = parse(compose(command), SCHEMAS[command])
    assert config.num_worlds == 1024


def test_every_file_of_the_package_is_reached() -> None:
    commands = {f.stem for f in config_dir().glob("*.yaml")}
    assert commands >= set(SCHEMAS)
    assert {f.suffix for f in Path(config_dir()).rglob("*") if f.is_file()} == {".yaml"}


def test_experiment_paper_has_the_published_numbers() -> None:
    config = load_train_config(["experiment=paper"])
    assert (config.num_worlds, config.algo.steps) == (4096, 24)
    assert config.algo.actor_hidden == config.algo.critic_hidden == [512, 512, 128]
    assert (config.observation.policy_history, config.observation.critic_history) == (5, 5)
    assert config.substeps == 10
    assert config.samples == pytest.approx(4096 * 24 * 10_000, rel=1e-3)


def test_paper_ball_has_the_fitted_drag() -> None:
    ball = load_train_config(["ball=paper"]).ball
    area = math.pi * ball.radius**2
    drag = ball.air_density * ball.drag_coefficient * area / (2.0 * ball.mass)
    assert drag == pytest.approx(0.0991, abs=1e-4)  # 1/m, least squares on 22 real flights (paper)


def test_default_reward_is_the_paper_reward_with_its_changes() -> None:
    paper, ours = (load_train_config([f"reward={name}"]).reward for name in ("paper", "intercept"))
    assert set(ours.terms) == set(paper.terms) | {"arrival", "ready_stance", "return_velocity"}
    changed = {name for name in paper.terms if paper.terms[name] != ours.terms[name]}
    assert changed == {"paddle_to_target", "success"}


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("+gama=0.9", "gama"),
        ("+algo.gama=0.9", "algo.gama"),
        ("+reward.terms.success.wieght=3", "reward.terms.success.wieght"),
        ("+serve.velocity=[5.0,6.0]", "serve.velocity"),
    ],
)
def test_unknown_key_is_named(override: str, key: str) -> None:
    with pytest.raises(ConfigError, match=rf"'{key}'"):
        parse(compose("train", [override]), TrainConfig)


def test_unknown_override_is_named() -> None:
    with pytest.raises(HydraException, match=r"algo\.gama"):
        compose("train", ["algo.gama=0.9"])


def test_unknown_choice_is_named() -> None:
    with pytest.raises(HydraException, match="rubbr"):
        compose("train", ["ball=rubbr"])


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("num_worlds=many", "num_worlds"),
        ("num_worlds=1.5", "num_worlds"),
        ("algo.gamma=high", "algo.gamma"),
        ("algo.actor_hidden=[512,wide]", r"algo.actor_hidden\[1\]"),
        ("tensorboard=perhaps", "tensorboard"),
        ("reward.terms.success.weight=heavy", "reward.terms.success.weight"),
        ("serve.vx=[fast,slow]", r"serve.vx\[0\]"),
    ],
)
def test_wrong_type_is_named(override: str, key: str) -> None:
    with pytest.raises(ConfigError, match=rf"'{key}'"):
        parse(compose("train", [override]), TrainConfig)


@pytest.mark.parametrize("key", ["seed", "algo.gamma", "ball.table.height"])
def test_missing_key_is_named(key: str) -> None:
    with pytest.raises(ConfigError, match=rf"'{key}'"):
        parse(compose("train", [f"~{key}"]), TrainConfig)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("num_worlds=0", "num_worlds must be at least 1, got 0"),
        ("num_worlds=-4", "num_worlds must be at least 1, got -4"),
        ("reward.arm_offset=[0.1]", "reward.arm_offset needs two numbers"),
        ("reward.idle_base_xy=[1,2,3]", "reward.idle_base_xy needs two numbers"),
        ("observation.policy=[]", "observation.policy must name at least one"),
        ("algo.std=[{samples: 0, value: 0}]", "algo.std must be positive"),
        ("algo.learning_rate=-1", "0 < learning_rate_min <= learning_rate"),
        ("algo.learning_rate_min=0.1", "0 < learning_rate_min <= learning_rate"),
        ("algo.actor_hidden=[0]", "algo.actor_hidden: a layer has at least 1 unit"),
        ("algo.clip=-1", "algo.clip must be positive"),
        ("algo.gae_lambda=3", r"algo.gae_lambda must lie in \(0, 1\]"),
        ("predictor.learning_rate=-1", "predictor.learning_rate must be positive"),
        ("predictor.hidden=[-3]", "predictor.hidden: a layer has at least 1 unit"),
        ("samples=0", "samples must be positive"),
        ("serve.vx=[-5.0,-6.0]", "serve.vx: low -5.0 is above high -6.0"),
        ("serve.head_start=[-0.1,0.2]", "serve.head_start: -0.1 is below 0.0"),
        ("serve.x=[1.35]", r"serve.x must be \[low, high\]"),
        ("ball.table_restitution=1.2", r"ball.table_restitution must lie in \[0, 1\]"),
        ("ball.mass=0", "ball.mass must be positive"),
        ("engine.physics_dt=0", "engine.physics_dt must be positive"),
        ("engine.name=bullet", "engine must be auto, native or mjwarp"),
        ("engine.threads=-1", "engine.threads must be 0"),
        ("engine.contacts_per_world=0", "engine.contacts_per_world must be at least 1"),
        ("engine.cone=round", "engine.cone must be pyramidal or elliptic"),
        ("algo.gamma=1.1", r"algo.gamma must lie in \(0, 1\]"),
        ("algo.minibatches=0", "algo.minibatches must be at least 1"),
        ("algo.autocast=fp8", "algo.autocast must be auto, mixed, bf16 or fp32"),
        ("algo.std=[]", "algo.std needs at least one point"),
        ("randomization.kp_scale=[1.1,0.9]", "randomization.kp_scale: low 1.1 is above high 0.9"),
        ("minutes=-1", "minutes must not be negative"),
        ("sensing.mocap_delay=[0.01,0.004]", "sensing.mocap_delay: low 0.01 is above high 0.004"),
        ("sensing.mocap_delay=[-0.01,0.0]", "sensing.mocap_delay: -0.01 is below 0.0"),
        ("sensing.noise_scale=[2.0,1.0]", "sensing.noise_scale: low 2.0 is above high 1.0"),
        ("~reward.nothing_to_hit.low_z", "reward.nothing_to_hit needs exactly falling_x, low_z, past_x"),
        ("reward.target_mode=apex", "reward.target_mode must be intercept or clamp"),
        ("observation.policy_history=0", "observation.policy_history must be at least 1"),
    ],
)
def test_bad_value_is_named(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse(compose("train", [override]), TrainConfig)


def test_the_fit_of_a_flight_knows_one_control_step() -> None:
    with pytest.raises(ConfigError, match=r"features=flight needs robot.control_dt 0.02 s, got 0.01"):
        load_train_config(["predictor=filter", "robot.control_dt=0.01"])


def test_resume_and_init_from_exclude_each_other() -> None:
    with pytest.raises(ConfigError, match="resume or init_from"):
        load_train_config(["resume=a", "init_from=b"])


@pytest.mark.parametrize(("override", "message"), [("bench.repeats=0", "bench.repeats"), ("bench.parts=[gpu]", "gpu")])
def test_bad_bench_option_is_named(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse(compose("bench", [override]), BenchConfig)


def test_physics_step_must_divide_the_control_step() -> None:
    config = load_train_config(["engine.physics_dt=0.003"])
    with pytest.raises(ConfigError, match=r"engine.physics_dt 0\.003 must divide robot.control_dt 0\.02"):
        _ = config.substeps
    assert load_train_config(["engine.physics_dt=0.005"]).substeps == 4


def test_saved_configuration_comes_back_equal() -> None:
    config = load_train_config(["experiment=paper", "seed=7"])
    text = OmegaConf.to_yaml(OmegaConf.create(to_dict(config)))
    saved = OmegaConf.to_container(OmegaConf.create(text))
    assert isinstance(saved, dict)
    assert parse({str(key): value for key, value in saved.items()}, TrainConfig) == config


def test_only_dataclasses_are_dumped() -> None:
    with pytest.raises(ConfigError, match="not a configuration: dict"):
        to_dict({"num_worlds": 3})
