"""The policy as one ONNX file for the robot: written, described, and checked against torch.

The file takes histories of raw sensor readings and gives joint targets: normaliser, predictor, forward kinematics and
actor are in it (:mod:`pace.deploy.graph`). What the robot's own code needs besides lies in its metadata, as JSON. The
file is played beside torch on observations recorded in the task, and only kept if both agree.
"""

from __future__ import annotations

import json
import logging
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig
from torch import Tensor

from pace.config.base import parse, to_dict
from pace.config.commands import ExportConfig
from pace.config.overrides import ON_A_CPU
from pace.config.training import TrainConfig
from pace.deploy.graph import INPUTS, DeployedPolicy, input_ports, input_shapes, kept_outputs, output_ports
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.run_folder import VERSIONS, default_folder, git_state, versions
from pace.sim.robot import build_model, joint_gains, motor_lines, nominal_pose
from pace.sim.robot_spec import RobotSpec
from pace.task.env import TableTennisEnv
from pace.task.observations import POLICY, layout

FILE = "policy.onnx"  # in the folder that the command writes
FORMAT = 2  # of the metadata; 2: kept says which outputs the caller keeps
ACTION_NOISE = 0.3  # standard deviation added to the actions while observations are recorded, so that they vary
#: The check plays the task as saved, but for noise that is added to what the graph itself computes.
CHECK_OVERRIDES = ("sensing.base_shift=0.0", *ON_A_CPU)
#: What lies outside the file.
PROCEDURE = (
    "Run at 1 / control_dt Hz. Keep a history of each input, oldest frame first, and append a frame before each call: "
    "of the inputs named in kept, the output of the last call that stands beside them there. At the start fill every "
    "history with the first frame, but those of kept and ball_launched with 0. A new ball is a new track: set "
    "ball_launched to 1 in the frame in which it is first seen. Without a ball in view, repeat its last position. "
    "Start anew after a fall and with another paddle, not with every ball. Send joint_target to the position "
    "controllers with the gains kp and kd. World frame: origin on the floor below the table's centre, x towards the "
    "opponent, y to the robot's left, z up."
)

Session = Any  # onnxruntime has no type information


class ExportError(RuntimeError):
    """A policy that cannot be exported, or a file that does not compute what torch computes."""


def export_from_config(composed: DictConfig) -> None:
    """Export as the composed configuration says; print what was written and how well it agrees with torch."""
    config = parse(composed, ExportConfig)
    assert config.run is not None  # ExportConfig has seen to it
    policy = load_policy(config.run)
    folder = Path(config.out) if config.out else default_folder("export")
    if folder.suffix == ".onnx":
        raise ExportError(f"out={folder} must be a folder, in which policy.onnx is written")
    out = folder / FILE
    differences = export_policy(policy, out, config)
    count = config.check_worlds * config.check_steps
    units = output_ports(policy.config)
    print(f"policy {policy.source}")
    print(f"largest difference between onnxruntime and torch over {count:,} recorded observations:")
    for name, value in differences.items():
        print(f"  {name:<20}{value:.1e} {units[name].unit}")
    print(f"wrote {out} ({out.stat().st_size / 2**20:.2f} MiB)")


def export_policy(policy: TaskPolicy, out: Path, config: ExportConfig) -> dict[str, float]:
    """Write ``out`` and return the largest difference of each output to torch on recorded observations.

    Errors: :class:`ExportError` for a difference above ``config.tolerance`` (the file is then not written), for a
    missing package and a folder that cannot be written.
    """
    _require_packages()
    model = build_model(policy.config.robot, policy.config.engine, policy.config.ball.table)
    graph = DeployedPolicy(policy, model).eval()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export_") as folder:
            file = Path(folder) / "policy.onnx"
            save_graph(graph, policy.config, file)
            differences = compare(open_session(file), policy, config)
            largest = max(differences.values())
            if not largest <= config.tolerance:  # also NaN
                raise ExportError(f"onnxruntime and torch differ by {largest:.2g}, more than {config.tolerance:g}")
            describe(file, metadata(policy, differences, config))
            file.replace(out)
    except OSError as error:
        raise ExportError(f"{out} cannot be written: {error}") from error
    return differences


def _require_packages() -> None:
    try:
        import onnx
        import onnxruntime
        import onnxscript
    except ImportError as error:
        raise ExportError(f"{error}: pip install 'pace-table-tennis[export]'") from error
    del onnx, onnxruntime, onnxscript


def save_graph(graph: DeployedPolicy, config: TrainConfig, file: Path) -> None:
    """Write the graph as ONNX, for any number of robots in one call."""
    example = tuple(torch.zeros(2, *shape) for shape in input_shapes(config).values())
    robots = torch.export.Dim("robots")
    shapes = [{0: robots} for _ in example]
    kept = tuple(shapes[len(INPUTS) :])  # one argument of forward, *kept
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it looks for torchvision, which nothing here needs
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="# The axis name: robots")  # it is the same axis of all inputs
        warnings.simplefilter("ignore", FutureWarning)  # of torch about itself
        program = torch.onnx.export(
            graph,
            example,
            dynamo=True,
            input_names=list(input_ports(config)),
            output_names=list(output_ports(config)),
            dynamic_shapes=(*shapes[: len(INPUTS)], *((kept,) if kept else ())),
            verbose=False,
        )
    assert program is not None
    program.save(str(file))


def describe(file: Path, content: Mapping[str, Any]) -> None:
    """Put ``content`` into the file's metadata, each value as JSON, and take the exporter's own traces out."""
    import onnx

    model = onnx.load(str(file))
    for node in model.graph.node:
        del node.metadata_props[:]  # paths and stack traces of this machine
        node.doc_string = ""
    for value in (*model.graph.input, *model.graph.output, *model.graph.value_info, *model.graph.initializer):
        del value.metadata_props[:]
    del model.metadata_props[:], model.graph.metadata_props[:]
    onnx.helper.set_model_props(model, {name: json.dumps(value) for name, value in content.items()})
    model.producer_name, model.producer_version = "pace", str(content["versions"]["packages"]["pace-table-tennis"])
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(file))


def metadata(policy: TaskPolicy, differences: Mapping[str, float], options: ExportConfig) -> dict[str, Any]:
    """All that the robot's own code needs to know, ready for JSON."""
    config = policy.config
    kp, kd, effort = joint_gains(config.robot).tolist()
    lines = motor_lines(config.robot)
    max_speed, stall_torque = (None, None) if lines is None else lines.tolist()
    model = build_model(config.robot, config.engine, config.ball.table)
    shapes = input_shapes(config)
    columns = layout(config.observation.policy, POLICY)
    return {
        "format": FORMAT,
        "procedure": PROCEDURE,
        "joint_names": list(RobotSpec.of(config.robot).joints),
        "nominal_pose": nominal_pose(config.robot).tolist(),
        "joint_range": model.jnt_range[1:].tolist(),
        "kp": kp,
        "kd": kd,
        "effort": effort,
        "max_speed": max_speed,  # rad/s: the drive falls from the stall torque (N m) at rest to zero there; null: none
        "stall_torque": stall_torque,
        "armature": config.robot.armature,
        "action_scale": config.robot.action_scale,
        "action_clip": config.robot.action_clip,
        "control_dt": config.robot.control_dt,
        "inputs": {name: {"shape": shapes[name], **port._asdict()} for name, port in input_ports(config).items()},
        "outputs": {name: port._asdict() for name, port in output_ports(config).items()},
        "kept": kept_outputs(config),
        "observation": {
            "history": config.observation.policy_history,
            "frame": {name: [where.start, where.stop] for name, where in columns.items()},
        },
        "sensing": {**to_dict(config.sensing), "distribution": "uniform, +- amplitude; delays in s"},
        "actuator_delay": config.randomization.actuator_delay,
        "config": to_dict(config),
        "source": policy.source,
        "counters": dict(policy.counters),
        "training": training_versions(policy),
        "git": git_state(Path(__file__).resolve().parent),
        "versions": versions(),
        "check": {"largest_difference": dict(differences), **to_dict(options)},
    }


def training_versions(policy: TaskPolicy) -> dict[str, Any] | None:
    """Versions and git commit that the run was trained with; None where the run folder does not say."""
    checkpoint = Path(policy.source)
    for folder in (checkpoint, checkpoint.parent.parent):  # a kept policy, or a checkpoint of a run
        if (folder / VERSIONS).is_file():
            try:
                return json.loads((folder / VERSIONS).read_text())
            except (OSError, ValueError):
                return None
    return None


class RawReadings:
    """The graph's inputs as a robot would keep them, from the sensors of an environment's N worlds.

    Attributes: ``histories`` name -> (N, frames, size).
    """

    def __init__(self, env: TableTennisEnv, config: TrainConfig) -> None:
        self.env, self.kept = env, kept_outputs(config)
        shapes = input_shapes(config)
        self.histories = {name: torch.zeros(env.num_worlds, *shape) for name, shape in shapes.items()}
        self.fill(torch.ones(env.num_worlds, dtype=torch.bool))

    def read(self) -> dict[str, Tensor]:
        """The present frame."""
        env, sensing = self.env, self.env.sensing
        names = ("base_angular_velocity", "base_position", "projected_gravity", "heading", "joint_velocity")
        frame = {name: getattr(sensing, name) for name in (*names, "ball_position")}
        frame["joint_position"] = sensing.joint_position + env.worlds.nominal
        frame["previous_action"] = env.task_state.action
        return frame

    def push(self, new_ball: Tensor, outputs: Mapping[str, NDArray[np.float32]]) -> None:
        """Append the present frame; ``new_ball`` (N,) bool, ``outputs`` of the graph's last call, each (N, size)."""
        kept = {name: torch.from_numpy(outputs[output]) for name, output in self.kept.items()}
        frame = kept | self.read() | {"ball_launched": new_ball.float().unsqueeze(-1)}  # the action is what was done
        for name, history in self.histories.items():
            history.copy_(torch.cat((history[:, 1:], frame[name].unsqueeze(1)), dim=1))

    def fill(self, mask: Tensor) -> None:
        """Start anew in the worlds of ``mask`` (N,) bool."""
        for name, value in self.read().items():
            self.histories[name][mask] = value[mask].unsqueeze(1)
        for name in ("ball_launched", *self.kept):
            self.histories[name][mask] = 0.0

    def numpy(self) -> dict[str, NDArray[np.float32]]:
        """What onnxruntime takes."""
        return {name: history.numpy() for name, history in self.histories.items()}


def open_session(file: Path) -> Session:
    """The file in onnxruntime, on one thread of the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors
    return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])


def compare(session: Session, policy: TaskPolicy, config: ExportConfig) -> dict[str, float]:
    """Largest difference of each output to what the task itself computes, over recorded observations.

    Worlds play with the policy and some noise on its actions; serves follow one another and robots fall.
    """
    env = policy.make_env(config.check_worlds, "cpu", config.seed, CHECK_OVERRIDES)
    readings, names = RawReadings(env, policy.config), list(output_ports(policy.config))
    generator = torch.Generator().manual_seed(config.seed)
    largest = dict.fromkeys(names, 0.0)
    for _ in range(config.check_steps):
        found = dict(zip(names, session.run(None, readings.numpy()), strict=True))
        action = policy(env.policy_observation)
        expected = expected_outputs(env, policy, action)
        for name, value in expected.items():
            difference = float(np.abs(found[name][:, -value.shape[1] :] - value.numpy()).max())
            largest[name] = difference if np.isnan(difference) else max(largest[name], difference)
        env.advance(action + ACTION_NOISE * torch.randn(action.shape, generator=generator))
        done = env.terminated | env.truncated
        readings.push(env.game.ends.next_serve, found)
        env.reset_worlds(done)
        readings.fill(done)
    return {name: largest[name] for name in expected_outputs(env, policy, policy(env.policy_observation))}


def expected_outputs(env: TableTennisEnv, policy: TaskPolicy, action: Tensor) -> dict[str, Tensor]:
    """The graph's outputs by name, as far as the environment has them; of the memory its last numbers alone: the rest
    differs after a reset, when the graph has seen the paddle once and the environment has not yet."""
    robot, actor = policy.config.robot, env.actor
    clipped = action.clamp(-robot.action_clip, robot.action_clip)
    outputs = {
        "joint_target": env.worlds.nominal + robot.action_scale * clipped,
        "action": clipped,
        "predicted_apex": actor.apex,
        "predicted_target": actor.target,
        "predicted_time": actor.time.unsqueeze(-1),
        "something_to_hit": actor.track.something_to_hit.float().unsqueeze(-1),
    }
    if actor.memory is not None:
        outputs["return_memory_next"] = actor.memory.seen
    if actor.delay is not None:
        outputs["delay_estimate_next"] = actor.delay.state
    if actor.attitude is not None:
        outputs["attitude_next"] = actor.attitude.state
    if actor.joints is not None:
        outputs["joints_next"] = actor.joints.state
    return outputs
