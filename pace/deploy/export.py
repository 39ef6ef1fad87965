"""The policy as one ONNX file for the robot: written, described, and checked against torch.

The file takes one frame of raw sensor readings and a state, and gives joint targets and the next state: normaliser,
predictor, estimates, forward kinematics and actor are in it (:mod:`pace.deploy.graph`). What else the robot's own code
needs lies in its metadata, as JSON, and in the contract beside it (:mod:`pace.deploy.contract`). The file is played
beside torch on observations recorded in the task, and only kept if both agree.
"""

from __future__ import annotations

import json
import logging
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import torch
from omegaconf import DictConfig

from pace.config.base import compose, parse, to_dict
from pace.config.commands import ExportConfig
from pace.config.extras import cure
from pace.config.training import TrainConfig
from pace.deploy.check import compare, open_session
from pace.deploy.contract import STEPS, write_contract
from pace.deploy.graph import (
    DeployedPolicy,
    input_ports,
    joints_of,
    output_ports,
    state_parts,
)
from pace.deploy.player import FORMAT
from pace.onboard.estimate import columns
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.exported import CONTRACT_FILE, POLICY_FILE
from pace.runs.own_files import make_out
from pace.runs.run_folder import VERSIONS, versions
from pace.sim.robot import build_model, joint_armature, joint_friction, joint_gains, motor_lines, nominal_pose
from pace.sim.robot_spec import RobotSpec
from pace.task.observations import POLICY, layout

#: What lies outside the file.
PROCEDURE = (
    "Run at 1 / control_dt Hz: give the current readings, and as state the state_next of the call before. A state of "
    "zeros starts from scratch: at the start, after a fall and with another paddle, not with every ball: a new ball is "
    "found from its positions. While no frame shows the ball, repeat its last position with ball_new 0; likewise for "
    "the base. Send joint_target to the position controllers with the gains kp and kd. World frame: origin on the "
    "floor below the table's centre, x towards the opponent, y to the robot's left, z up."
)


class ExportError(RuntimeError):
    """A policy that cannot be exported, or a file that does not compute what torch computes."""


def export_from_config(composed: DictConfig) -> None:
    """Export as the composed configuration says; print what was written and how well it agrees with torch."""
    config = parse(composed, ExportConfig)
    assert config.run is not None  # guaranteed by ExportConfig
    policy = load_policy(config.run)
    if config.out and Path(config.out).suffix == ".onnx":
        raise ExportError(f"out={config.out} must be a folder, in which policy.onnx is written")
    out = make_out(config.out, "export", [POLICY_FILE, CONTRACT_FILE]) / POLICY_FILE
    differences = export_policy(policy, out, config)
    count = config.check_worlds * config.check_steps
    units = {name: port.unit for name, port in output_ports(policy.config).items()}
    print(f"policy {policy.source}")
    print(f"largest difference between onnxruntime and torch over {count:,} recorded observations:")
    for name, value in differences.items():
        print(f"  {name:<20}{value:.1e} {units.get(name, '(state)')}")
    print(f"wrote {out} ({out.stat().st_size / 2**20:.2f} MiB)\nwrote {out.with_suffix('.json')}")


def export_run(run: Path) -> Path:
    """Export a run's newest policy into its folder, as ``pace export`` does if nothing else is asked; the file.

    Errors: :class:`ExportError`.
    """
    usual = parse(compose("export", [f"run='{run}'"]), ExportConfig)
    export_policy(load_policy(run), run / POLICY_FILE, usual)
    return run / POLICY_FILE


def export_policy(policy: TaskPolicy, out: Path, config: ExportConfig) -> dict[str, float]:
    """Write ``out`` and its contract, and return the largest difference of each output to torch on recorded
    observations.

    Errors: :class:`ExportError` for a difference above ``config.tolerance`` (the file is then not written), for a
    missing package and a folder that cannot be written.
    """
    _require_packages()
    model = build_model(policy.config.robot, policy.config.engine, policy.config.ball.table)
    graph = DeployedPolicy(policy, model).eval()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export_") as folder:
            file = Path(folder) / out.name
            save_graph(graph, policy.config, file)
            frames: list[dict[str, Any]] = []
            session = open_session(file)
            differences = compare(session, policy, config, frames)
            largest = max(differences.values())
            if not largest <= config.tolerance:  # also NaN
                raise ExportError(f"onnxruntime and torch differ by {largest:.2g}, more than {config.tolerance:g}")
            content = metadata(policy, model, differences, config)
            describe(file, content)
            beside = write_contract(file, content, session, frames[:STEPS], config.tolerance)
            file.replace(out)
            beside.replace(out.with_suffix(".json"))
    except OSError as error:
        raise ExportError(f"{out} cannot be written: {error}") from error
    return differences


def _require_packages() -> None:
    try:
        import onnx
        import onnxruntime
        import onnxscript
    except ImportError as error:
        raise ExportError(f"{error}: {cure('export')}") from error
    del onnx, onnxruntime, onnxscript


def save_graph(graph: DeployedPolicy, config: TrainConfig, file: Path) -> None:
    """Write the graph as ONNX, for any number of robots in one call."""
    example = tuple(torch.zeros(2, port.size) for port in input_ports(config).values())
    robots = torch.export.Dim("robots")
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
            dynamic_shapes=tuple({0: robots} for _ in example),
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


def metadata(
    policy: TaskPolicy, model: mujoco.MjModel, differences: Mapping[str, float], options: ExportConfig
) -> dict[str, Any]:
    """All that the robot's own code needs to know, ready for JSON; ``model`` of the policy's robot."""
    config, program = policy.config, versions()
    kp, kd, effort = joint_gains(config.robot).tolist()
    lines = motor_lines(config.robot)
    max_speed, stall_torque = (None, None) if lines is None else lines.tolist()
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
        "armature": joint_armature(config.robot).tolist(),
        "friction": joint_friction(config.robot).tolist(),
        "action_scale": config.robot.action_scale,
        "action_clip": config.robot.action_clip,
        "control_dt": config.robot.control_dt,
        "inputs": {name: port._asdict() for name, port in input_ports(config).items()},
        "outputs": {name: port._asdict() for name, port in output_ports(config).items()},
        "state": _describe_state(config),
        "observation": {
            "history": config.observation.policy_history,
            "frame": _ranges(layout(config.observation.policy, POLICY, joints_of(config))),
        },
        "sensing": {**to_dict(config.sensing), "distribution": "uniform, +- amplitude; delays in s"},
        "actuator_delay": config.randomization.actuator_delay,
        "config": to_dict(config),
        "source": policy.source,
        "counters": dict(policy.counters),
        "training": training_versions(policy),
        "git": program["git"],
        "versions": program,
        "check": {"largest_difference": dict(differences), **to_dict(options)},
    }


def _describe_state(config: TrainConfig) -> dict[str, Any]:
    """What stands in which columns of the state: for the curious, since nobody has to know it."""
    parts = state_parts(config)
    where = _ranges(columns(parts))
    return {name: {"columns": where[name], "unit": p.unit, "meaning": p.meaning} for name, p in parts.items()}


def _ranges(slices: Mapping[str, slice]) -> dict[str, list[int]]:
    return {name: [where.start, where.stop] for name, where in slices.items()}


def training_versions(policy: TaskPolicy) -> dict[str, Any] | None:
    """Versions and git commit that the run was trained with; None where the run folder does not say."""
    checkpoint = Path(policy.source)
    for folder in (checkpoint, checkpoint.parent.parent):  # a kept policy, or a checkpoint of a run
        if (folder / VERSIONS).is_file():
            try:
                return json.loads((folder / VERSIONS).read_text(encoding="utf-8"))
            except (OSError, ValueError):
                return None
    return None
