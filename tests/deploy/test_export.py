"""The exported policy: what it computes, what it says about itself, and the example that plays it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from pace.config.base import ConfigError, compose, parse, to_dict
from pace.config.commands import ExportConfig
from pace.config.training import TrainConfig, load_train_config
from pace.deploy import export
from pace.deploy.__main__ import main
from pace.deploy.check import RawReadings, compare, open_session
from pace.deploy.export import ExportError, export_policy, training_versions
from pace.deploy.graph import DeployedPolicy, StateLayout, input_ports, output_ports, readings, results, state_parts
from pace.predictor.network import PredictorNetwork
from pace.rl.agent import Policy
from pace.rl.policies import TaskPolicy, built_in_policy, load_policy, policy_size
from pace.sim.ball.ball import BallParams, BallSim, ball_preset
from pace.sim.robot import build_model
from tests.helpers.robot import JOINT_NAMES
from tests.helpers.saved import make_agent, make_config, remembering_policy, save_run

EXAMPLE = Path(__file__).parents[2] / "examples" / "deploy_sim2sim.py"


def options(*overrides: str) -> ExportConfig:
    return parse(compose("export", ["run=any", "check_worlds=4", "check_steps=110", *overrides]), ExportConfig)


def make_model(config: TrainConfig) -> mujoco.MjModel:
    return build_model(config.robot, config.engine, config.ball.table)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def exported(run: Path) -> tuple[Path, dict[str, float]]:
    """The file, and how far it is from torch."""
    pytest.importorskip("onnxscript")
    file = run / "policy.onnx"
    return file, export_policy(load_policy(run), file, options())


@pytest.fixture(scope="module")
def remembering(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TaskPolicy, dict[str, float]]:
    """The file of a policy that hits and observes its returns, the policy, and how far they are from each other."""
    pytest.importorskip("onnxscript")
    file, policy = tmp_path_factory.mktemp("remembering") / "policy.onnx", remembering_policy()
    return file, policy, export_policy(policy, file, options())


@pytest.fixture(scope="module")
def example() -> Any:
    """The example as a module."""
    spec = spec_from_file_location("deploy_sim2sim", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def stored(file: Path) -> dict[str, Any]:
    return {name: json.loads(text) for name, text in open_session(file).get_modelmeta().custom_metadata_map.items()}


def test_it_computes_what_the_task_computes(exported: tuple[Path, dict[str, float]]) -> None:
    file, differences = exported
    names = ["joint_target", "action", "predicted_apex", "predicted_target", "predicted_time", "something_to_hit"]
    assert list(differences) == names
    assert max(differences.values()) < 1e-5
    session = open_session(file)
    assert [port.name for port in session.get_inputs()] == [*readings(21), "state"]
    assert [port.name for port in session.get_outputs()] == [*results(21), "state_next"]
    assert stored(file)["check"]["largest_difference"] == differences
    assert list(file.parent.glob(".export_*")) == []


def test_the_metadata_is_what_a_robot_needs(exported: tuple[Path, dict[str, float]], run: Path) -> None:
    meta, config = stored(exported[0]), make_config()
    model = make_model(config)
    assert meta["joint_names"] == list(JOINT_NAMES)
    assert meta["nominal_pose"] == pytest.approx(model.key_qpos[0, 7:].tolist())
    assert meta["kp"] == pytest.approx(model.actuator_gainprm[:, 4].tolist())
    assert meta["kd"] == pytest.approx(model.actuator_gainprm[:, 6].tolist())
    assert meta["max_speed"] == pytest.approx(model.actuator_gainprm[:, 7].tolist())
    resistance = np.divide(meta["max_speed"], meta["stall_torque"])
    assert resistance == pytest.approx(model.actuator_gainprm[:, 0])
    assert meta["effort"] == pytest.approx(model.actuator_forcerange[:, 1].tolist())
    assert (meta["action_scale"], meta["control_dt"]) == (0.25, 0.02)
    assert meta["armature"] == pytest.approx(model.dof_armature[6:].tolist())
    assert meta["friction"] == pytest.approx(model.dof_frictionloss[6:].tolist())
    assert (meta["sensing"]["ball_position"], meta["sensing"]["mocap_delay"]) == (0.007, [0.004, 0.01])
    assert meta["actuator_delay"] == [0.0, 0.006]
    assert meta["config"]["reward"]["scale"] == 0.125  # of the run, not of configs/
    assert meta["observation"]["history"] * meta["observation"]["frame"]["something_to_hit"][1] == policy_size(config)
    assert {name: port["size"] for name, port in meta["inputs"].items()} == {
        name: port.size for name, port in input_ports(config).items()
    }
    assert list(meta["state"]) == ["started", "action", "turned", "age", "track", "history"]
    assert meta["state"]["track"]["columns"] == [24, 24 + 15]
    assert meta["state"]["history"]["columns"][1] == meta["inputs"]["state"]["size"] == 24 + 15 + 4 * 90
    assert meta["counters"]["updates"] == 3
    assert meta["source"].startswith(str(run))
    assert len(meta["git"]["commit"]) == 40


def fresh_policy(overrides: Sequence[str]) -> TaskPolicy:
    """A policy of random weights on another task."""
    config = load_train_config(["algo.actor_hidden=[8]", "algo.critic_hidden=[8]", "algo.autocast=fp32", *overrides])
    agent, network = make_agent(config), Policy.build(policy_size(config), 21, config.algo)
    network.norm.load_state_dict(agent.policy_norm.state_dict())
    network.mlp.load_state_dict(agent.actor.mlp.state_dict())
    return TaskPolicy(config, network.eval(), PredictorNetwork(config.predictor), "fresh")


def test_the_commit_of_the_training_is_found(tmp_path: Path) -> None:
    run = save_run(tmp_path / "run")
    policy = load_policy(run)
    assert training_versions(policy) is None
    (run / "versions.json").write_text('{"git": {"commit": "abc"}}')
    assert training_versions(policy) == {"git": {"commit": "abc"}}
    (Path(policy.source) / "versions.json").write_text(
        '{"git": {"commit": "def"}}'
    )  # as pace.evaluation.keep leaves it
    assert training_versions(policy) == {"git": {"commit": "def"}}
    (Path(policy.source) / "versions.json").write_text("{")
    assert training_versions(policy) is None


class TorchSession:
    """The graph before it became a file."""

    def __init__(self, policy: TaskPolicy) -> None:
        self.graph, self.names = DeployedPolicy(policy, make_model(policy.config)), input_ports(policy.config)
        self.memory = StateLayout(policy.config).columns.get("memory")

    @torch.no_grad()
    def run(self, _: None, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        return [output.numpy() for output in self.graph(*(torch.from_numpy(inputs[name]) for name in self.names))]


@pytest.mark.parametrize(
    "overrides",
    [
        ("observation=paper", "predictor=paper", "reward=paper"),
        ("predictor.enabled=false", "observation.policy_history=1"),
        ("predictor=filter",),
    ],
)
def test_other_tasks_have_their_own_graph(overrides: tuple[str, ...]) -> None:
    policy = fresh_policy(overrides)
    differences = compare(TorchSession(policy), policy, options("check_steps=60"))
    assert max(differences.values()) < 1e-5


class Forgetful(TorchSession):
    """The graph of a caller who does not keep the memory."""

    def run(self, _: None, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        state = inputs["state"].copy()
        state[:, self.memory] = 0.0
        return super().run(None, inputs | {"state": state})


class Watched:
    """A file in onnxruntime. Attribute: ``seen`` (4, 5), the largest that came back to each world from the memory."""

    def __init__(self, file: Path) -> None:
        self.session, self.seen = open_session(file), np.zeros((4, 5))
        self.columns = slice(*stored(file)["state"]["memory.last_return"]["columns"])

    def run(self, names: None, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        self.seen = np.maximum(self.seen, np.abs(inputs["state"][:, self.columns]))
        return self.session.run(names, inputs)


@pytest.mark.slow
def test_a_policy_that_remembers_its_returns(remembering: tuple[Path, TaskPolicy, dict[str, float]]) -> None:
    file, policy, differences = remembering
    assert max(differences.values()) < 1e-4
    assert sorted(list(differences)[-4:]) == ["attitude", "delay", "joints", "memory"]
    session, meta = open_session(file), stored(file)
    assert [port.name for port in session.get_inputs()] == list(input_ports(policy.config)) == [*readings(21), "state"]
    assert [port.name for port in session.get_outputs()] == list(output_ports(policy.config))
    columns = StateLayout(policy.config).columns
    sizes = {name: columns[name].stop - columns[name].start for name in ("memory", "delay", "attitude", "joints")}
    assert sizes == {"memory": 24, "delay": 8, "attitude": 9, "joints": 43}
    ends = [part["columns"] for part in meta["state"].values()]
    assert ends[0] == [0, 1]
    assert all(before[1] == after[0] for before, after in pairwise(ends))  # in order, without a gap
    assert ends[-1][1] == meta["inputs"]["state"]["size"] == meta["outputs"]["state_next"]["size"]
    assert meta["state"]["delay.delay"]["unit"] == "s"


@pytest.mark.slow
def test_the_filter_of_the_whole_flight_is_exported_for_any_number_of_robots(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    policy = fresh_policy(["observation=memory", "predictor=filter"])
    assert max(export_policy(policy, tmp_path / "policy.onnx", options("check_steps=40")).values()) < 1e-4


@pytest.mark.slow
def test_returns_are_seen_while_it_is_compared(remembering: tuple[Path, TaskPolicy, dict[str, float]]) -> None:
    """Serves are returned in the recorded observations, and what is remembered of them changes the action."""
    file, policy, _ = remembering
    watched = Watched(file)
    assert max(compare(watched, policy, options()).values()) < 1e-4
    assert (watched.seen > 0.0).all(axis=1).sum() >= 2
    assert compare(Forgetful(policy), policy, options())["action"] > 0.01


def test_memory_and_one_frame_of_history() -> None:
    policy = fresh_policy(["observation=memory", "observation.policy_history=1"])
    assert max(compare(TorchSession(policy), policy, options("check_steps=60")).values()) < 1e-5
    unused = fresh_policy(["observation=memory", "observation.policy=[base_position]"])
    assert "memory" not in StateLayout(unused.config).columns
    assert max(compare(TorchSession(unused), unused, options("check_steps=5")).values()) < 1e-5


def test_a_wrong_file_is_not_kept(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "save_graph", lambda graph, config, file: file.touch())
    monkeypatch.setattr(export, "open_session", lambda file: None)
    monkeypatch.setattr(export, "compare", lambda *_: {"joint_target": 4e-4})
    with pytest.raises(ExportError, match=r"differ by 0\.0004"):
        export_policy(load_policy(run), tmp_path / "policy.onnx", options())
    monkeypatch.setattr(export, "compare", lambda *_: {"joint_target": float("nan")})
    with pytest.raises(ExportError, match="differ by nan"):
        export_policy(load_policy(run), tmp_path / "policy.onnx", options())
    assert list(tmp_path.iterdir()) == []


def test_bad_input_is_one_line(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, status, message in (
        ([], 2, "which run?"),
        (["/nowhere"], 1, "does not exist"),
        ([str(run), f"out={tmp_path / 'policy.onnx'}"], 1, "must be a folder"),
        ([str(run), "speed=1"], 2, "speed"),
    ):
        monkeypatch.setattr("sys.argv", ["export", *arguments])
        assert main() == status
        error = capsys.readouterr().err.strip()
        assert error.startswith("error: ")
        assert message in error
        assert "\n" not in error
    with pytest.raises(ConfigError, match="check_steps"):
        options("check_steps=0")
    with pytest.raises(TypeError, match="zero is no network"):
        DeployedPolicy(built_in_policy("zero", 1), make_model(make_config()))


def follow(controller: Any, policy: TaskPolicy) -> int:
    """Play the task beside the example's controller, which must say the same; balls after the first, and falls."""
    env = policy.make_env(1, "cpu", 4, ["sensing.base_shift=0.0", "engine.threads=1", "serve.serves_per_episode=0"])
    restarts, serves = 0, 0
    for _ in range(200):
        frame = {name: value[0] for name, value in RawReadings(env, policy.config).numpy().items()}
        action = policy(env.policy_observation)
        expected = env.worlds.nominal + 0.25 * action[0]
        found = controller({name: frame[name] for name in readings(21)})
        assert np.abs(found - expected.numpy()).max() < 1e-5
        assert np.abs(controller.outputs["predicted_apex"] - env.actor.apex[0].numpy()).max() < 1e-5
        env.advance(action)
        serves += bool(env.game.ends.next_serve)
        if bool(env.terminated):
            env.reset_worlds(env.terminated)
            controller.restart()
            restarts += 1
    return restarts + serves


def test_the_example_gives_the_targets_of_the_task(exported: tuple[Path, dict[str, float]], example: Any) -> None:
    assert follow(example.Controller(exported[0]), load_policy(exported[0].parent)) > 0


@pytest.mark.slow
def test_the_example_remembers_its_returns(
    remembering: tuple[Path, TaskPolicy, dict[str, float]], example: Any
) -> None:
    controller = example.Controller(remembering[0])
    assert follow(controller, remembering[1]) > 0
    columns = slice(*controller.meta["state"]["memory.last_return"]["columns"])
    assert np.abs(controller.outputs["state_next"][columns]).min() > 0.0


def test_the_example_refuses_files_of_other_versions(
    exported: tuple[Path, dict[str, float]], example: Any, tmp_path: Path
) -> None:
    import onnx

    model = onnx.load(str(exported[0]))
    onnx.helper.set_model_props(model, {"format": "1"})
    onnx.save(model, str(tmp_path / "old.onnx"))
    with pytest.raises(ValueError, match="format 1, not 5: export it again"):
        example.Controller(tmp_path / "old.onnx")


def far_blade(example: Any) -> Any:
    """A paddle that is in nobody's way."""
    return example.Blade(np.array([0.0, 0.0, 9.0]), np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))


def test_the_example_has_the_motors_of_the_training(exported: tuple[Path, dict[str, float]], example: Any) -> None:
    meta, ours = stored(exported[0]), make_model(make_config())
    model = example.build_model(example.SCENE, meta)
    for name in ("gaintype", "gainprm", "biastype", "biasprm", "dyntype", "dynprm", "ctrlspec", "forcerange"):
        np.testing.assert_allclose(getattr(model, f"actuator_{name}"), getattr(ours, f"actuator_{name}"), err_msg=name)
    before = {name: value for name, value in meta.items() if name not in ("max_speed", "stall_torque")}
    model = example.build_model(example.SCENE, before)  # a file from before the motors knew their speed
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], meta["kp"])
    np.testing.assert_allclose(model.actuator_biasprm[:, 2], np.negative(meta["kd"]))


@pytest.mark.parametrize("name", ["venue", "rubber"])  # constant lift; measured air, rubber that springs back
def test_the_example_flies_the_same_ball(example: Any, name: str) -> None:
    preset = ball_preset(name)
    sim = BallSim(1, "cpu", BallParams.from_config(preset), preset.table, 0.002, 1, 0.002)
    velocity, spin = np.array([-5.8, -0.2, 1.7]), np.array([20.0, 60.0, -30.0])
    ahead, ball = (example.Ball(to_dict(preset)) for _ in range(2))
    for each in (ahead, ball):
        each.serve(example.SERVE_START, velocity)
        each.spin = spin
    for _ in range(550):
        ahead.step(0.001, far_blade(example), far_blade(example))
    for tensor, value in ((sim.position, ball.position), (sim.velocity, velocity), (sim.spin, spin)):
        tensor[0] = torch.from_numpy(value)
    normal, speed, turning = np.array([0.96, 0.0, 0.28]), np.array([1.5, 0.2, 0.5]), np.array([0.0, 2.0, 0.0])
    surfaces: list[str] = []
    for step in range(400):  # the paddle's centre comes to where the ball is at 0.55 s
        times = [0.002 * step - 0.55 + dt for dt in (0.0, 0.001, 0.002)]
        blades = [example.Blade(ahead.position + time * speed, normal, speed, turning) for time in times]
        sim.fly(torch.from_numpy(np.stack([np.concatenate(blades[i]) for i in (0, 2)])).float().unsqueeze(0))
        surfaces += [contact.surface for a, b in pairwise(blades) for contact in ball.step(0.001, a, b)]
        assert np.abs(ball.position - sim.position[0].numpy()).max() < 0.004, (step, surfaces)
    assert surfaces == ["own", "paddle"]
    assert ball.velocity[0] > 2.0
    assert np.abs(ball.velocity - sim.velocity[0].numpy()).max() < 0.05
    assert np.abs(ball.spin - sim.spin[0].numpy()).max() < 3.0


def test_the_example_needs_only_the_player_and_outruns_the_clock(exported: tuple[Path, dict[str, float]]) -> None:
    code = (
        "import runpy, sys\n"
        f"sys.argv = ['x', {str(exported[0])!r}, '--serves', '3', '--seed', '2']\n"
        f"try:\n    runpy.run_path({str(EXAMPLE)!r}, run_name='__main__')\n"
        "except SystemExit as end:\n    assert end.code == 0, end.code\n"
        "loaded = {name.split('.')[0] for name in sys.modules}\n"
        "print(sorted(loaded & {'torch', 'warp', 'onnx', 'scipy', 'hydra', 'yaml', 'matplotlib'}))\n"
        "print(sorted(name for name in sys.modules if name.startswith('pace.')))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.strip().splitlines()
    assert lines[1].startswith("3 serves: hit ")
    assert float(lines[2].split(": ")[1].split(" ")[0]) > 1.0
    assert lines[3] == "[]"
    assert lines[4] == str(["pace.deploy", "pace.deploy.player", "pace.lazy", "pace.moved"])


def test_the_example_refuses_other_files(tmp_path: Path) -> None:
    (tmp_path / "x.onnx").write_text("nothing")
    for file in (tmp_path / "x.onnx", tmp_path / "nowhere.onnx"):
        done = subprocess.run([sys.executable, str(EXAMPLE), str(file)], capture_output=True, text=True, timeout=100)
        assert done.returncode == 1
        assert done.stderr.startswith(f"error: {file} cannot be used")
        assert len(done.stderr.strip().splitlines()) == 1


def test_the_referee_of_the_example(example: Any) -> None:
    for surfaces, hit, outcome in (
        (["own", "paddle", "opponent"], True, "success"),
        (["own", "paddle", "net", "own"], True, "own side"),
        (["own", "paddle", "floor", "paddle"], True, "out"),
        (["own", "own", "paddle"], False, "miss"),
        (["paddle"], False, "volley"),
        (["opponent", "floor"], False, "miss"),
    ):
        referee = example.Referee()
        for surface in surfaces:
            referee.see(example.Contact(surface, np.zeros(3), np.zeros(3), np.zeros(3)))
        assert (referee.hit, referee.outcome) == (hit, outcome), surfaces


def test_a_shorter_history_of_the_policy_keeps_the_balls() -> None:
    config = make_config()
    short = replace(config, observation=replace(config.observation, policy_history=2))
    assert state_parts(short)["track"].size == 15
    assert state_parts(short)["history"].size == 90


def test_zeros_start_from_scratch_whatever_the_others_do() -> None:
    """Of two robots in one call one may start while the other plays."""
    policy = fresh_policy(["observation=memory"])
    graph = DeployedPolicy(policy, make_model(policy.config))
    torch.manual_seed(8)
    ports = input_ports(policy.config)
    first, second = ([torch.rand(2, port.size) for name, port in ports.items() if name != "state"] for _ in range(2))
    with torch.no_grad():
        played = graph(*first, torch.zeros(2, ports["state"].size))[-1]
        state = played.clone()
        state[1] = 0.0
        mixed = graph(*second, state)
        scratch, on = graph(*second, torch.zeros_like(state)), graph(*second, played)
    for one, start, later in zip(mixed, scratch, on, strict=True):
        torch.testing.assert_close(one, torch.stack((later[0], start[1])))
    assert not torch.equal(scratch[-1], on[-1])
