"""The contract beside an exported policy, the loader that refuses what does not fit, and logs through the file."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pace.config.commands import RetraceConfig
from pace.deploy.contract import STEPS
from pace.deploy.player import SHARED, Controller, Log, read_log
from pace.deploy.retrace import main
from pace.deploy.trace import report, retrace
from pace.rl.policies import load_policy
from tests.helpers.examples import assert_one_line, check, counts, json_values, st
from tests.helpers.saved import export_quickly, save_run

EXAMPLE = Path(__file__).parents[2] / "examples" / "deploy_sim2sim.py"


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exported policy, with its contract."""
    folder = tmp_path_factory.mktemp("robot")
    return export_quickly(load_policy(save_run(folder / "run")), folder)


@pytest.fixture
def copy(file: Path, tmp_path: Path) -> Path:
    """The same, to be changed."""
    shutil.copy(file.with_suffix(".json"), tmp_path / "policy.json")
    return Path(shutil.copy(file, tmp_path / "policy.onnx"))


@pytest.fixture(scope="module")
def log(file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of two serves in the simulation of the example."""
    path = tmp_path_factory.mktemp("log") / "sim.log"
    command = [sys.executable, str(EXAMPLE), str(file), "--serves", "2", "--log", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return path


def change(file: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    """Edit the contract of ``file``."""
    beside = file.with_suffix(".json")
    content = json.loads(beside.read_text())
    edit(content)
    beside.write_text(json.dumps(content))


# --- the contract -----------------------------------------------------------------------------------------------------


def test_the_contract_says_what_each_signal_is(file: Path) -> None:
    contract = json.loads(file.with_suffix(".json").read_text())
    assert contract["contract"] == 1
    assert contract["control_dt"] == 0.02
    assert len(contract["joint_names"]) == len(contract["kp"]) == len(contract["joint_range"]) == 21
    ball = contract["inputs"]["ball_position"]
    assert (ball["size"], ball["unit"], ball["frame"], ball["age"]) == (3, "m", "world", "ball_age")
    assert contract["inputs"]["base_angular_velocity"]["frame"] == "body"
    for port in (*contract["inputs"].values(), *contract["outputs"].values()):
        assert {"size", "unit", "meaning", "frame", "age"} == set(port)
    ages = {port["age"] for port in contract["inputs"].values()} - {"current"}
    assert ages <= set(contract["inputs"])  # each is an input that says it
    assert {name: np.shape(rows) for name, rows in contract["examples"]["readings"].items()} == {
        name: (STEPS, port["size"]) for name, port in contract["inputs"].items() if name != "state"
    }


def test_its_own_examples_come_out(file: Path) -> None:
    controller = Controller(file)
    assert controller.verify() < 1e-5
    examples = controller.contract["examples"]
    rows = np.array(examples["joint_target"])
    assert np.ptp(rows, axis=0).max() > 1e-3  # they move
    for index, target in enumerate(rows):
        readings = {name: values[index] for name, values in examples["readings"].items()}
        np.testing.assert_allclose(controller(readings), target, atol=1e-5)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda c: c.update(contract=2), "contract 2, not 1: export it again"),
        (lambda c: c.update(sha256="0"), "policy.json is the contract of another file"),
        (lambda c: c["joint_names"].reverse(), "the contract's joint_names is not that of the file"),
        (lambda c: c.update(control_dt=0.01), "the contract's control_dt is not that of the file"),
        (lambda c: c["inputs"]["ball_position"].update(frame="body"), "the contract's inputs is not that of the file"),
        (lambda c: c["kp"].pop(), "the contract's kp is not that of the file"),
        (lambda c: c["examples"]["joint_target"][3].__setitem__(4, 9.0), "the contract's example 3 gives targets that"),
        (lambda c: c["examples"]["readings"].pop("heading"), "examples.readings must have all readings"),
        (lambda c: c["examples"].update(tolerance=1e9), "examples.tolerance must be a number of rad between 0 and 1"),
        (lambda c: c["examples"]["joint_target"].pop(), "examples must have a row a step for each reading"),
    ],
)
def test_a_contract_that_does_not_fit_is_refused(copy: Path, edit: Callable[[Any], object], words: str) -> None:
    change(copy, edit)
    with pytest.raises(ValueError, match=words) as error:
        Controller(copy)
    assert_one_line(error.value)


def test_a_file_without_its_contract_or_with_another_robot_is_refused(copy: Path) -> None:
    names = Controller(copy).contract["joint_names"]
    Controller(copy, joints=names)
    with pytest.raises(ValueError, match=f"joint 0 of the robot is {names[1]}, of the policy {names[0]}"):
        Controller(copy, joints=[names[1], names[0], *names[2:]])
    with pytest.raises(ValueError, match="the robot has 20 joints, the policy 21"):
        Controller(copy, joints=names[:-1])
    copy.with_suffix(".json").write_text("{")
    with pytest.raises(ValueError, match=r"its contract policy.json cannot be read"):
        Controller(copy)
    copy.with_suffix(".json").unlink()
    with pytest.raises(ValueError, match=r"its contract policy.json is missing: pace export writes both"):
        Controller(copy)


@counts
def test_a_contract_of_any_content_is_refused_in_one_line_or_is_the_same(copy: Path, count: int) -> None:
    content = json.loads(copy.with_suffix(".json").read_text())
    keys = [(key,) for key in content] + [("examples", key) for key in content["examples"]]
    keys += [("examples", "readings", name) for name in content["examples"]["readings"]]
    told: list[str] = []

    @check(count, st.sampled_from(keys), json_values(), st.booleans())
    def contracts(path: tuple[str, ...], value: Any, delete: bool) -> None:
        changed = json.loads(json.dumps(content))
        inner = changed
        for key in path[:-1]:
            inner = inner[key]
        if delete:
            del inner[path[-1]]
        else:
            inner[path[-1]] = value
        copy.with_suffix(".json").write_text(json.dumps(changed))
        try:
            controller = Controller(copy)
        except ValueError as error:
            assert_one_line(error)
            told.append(str(error))
        else:
            assert all(controller.contract[key] == content[key] for key in SHARED)

    assert len(told) > count // 2


# --- logs -------------------------------------------------------------------------------------------------------------


def rows_of(file: Path, log: Path) -> tuple[Controller, dict[str, Any]]:
    controller = Controller(file)
    return controller, read_log(log, {**controller.sizes, "joint_target": 21})


def options(**changes: Any) -> RetraceConfig:
    return RetraceConfig(**{"policy": "x", "log": "x", "tolerance": 3e-4, "late": 0.1, "out": None, **changes})


def test_a_log_of_the_simulation_agrees(file: Path, log: Path) -> None:
    controller, rows = rows_of(file, log)
    trace = retrace(controller, rows)
    assert len(trace.time) > 50
    assert trace.restart[0]
    assert trace.difference.max() < 1e-5
    lines = report(trace, controller, rows, options())
    assert lines[1].startswith("targets agree: largest difference ")
    assert len(lines) == 2


def test_where_a_disturbed_log_parts_is_found(file: Path, log: Path) -> None:
    controller, rows = rows_of(file, log)
    rows["joint_position"][30:, 4] += 1.0  # rad: an encoder that slips
    trace = retrace(controller, rows)
    parted = np.flatnonzero(trace.difference.max(1) > 3e-4)
    assert parted[0] == 30
    lines = report(trace, controller, rows, options())
    assert lines[1].startswith(f"targets part at {rows['time'][30]:.3f} s (step 30): ")
    assert {line.split()[0] for line in lines[3:]} <= set(controller.contract["joint_names"])
    assert len(lines) == 8


def test_late_steps_old_frames_and_broken_readings_are_told(file: Path, log: Path) -> None:
    controller, rows = rows_of(file, log)
    rows["time"][20:] += 0.015
    rows["ball_age"][10:12] = 0.3
    rows["base_position"][40] = np.nan
    trace = retrace(controller, rows)
    assert list(trace.refused) == [40]
    text = "\n".join(report(trace, controller, rows, options()))
    assert f"1 steps are not 20 ms after the one before: 35.0 ms at {rows['time'][20]:.3f} s" in text
    assert "2 of " in text
    assert "frames with the ball are older than in training: 300 ms" in text
    assert (
        f"1 steps are refused, the first at {rows['time'][40]:.3f} s: the reading base_position is not finite" in text
    )


def test_the_command(file: Path, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr("sys.argv", ["pace retrace", str(file.parent), str(log), f"out={tmp_path / 'out'}"])
    assert main() == 0
    assert "targets agree" in capsys.readouterr().out
    assert (tmp_path / "out" / "retrace.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "which policy? give policy.onnx of pace export, then the log"),
        (("POLICY",), "which log? give the file"),
        (("nowhere.onnx", "LOG"), "nowhere.onnx cannot be used: "),
        (("POLICY", "POLICY"), "is no log: its first line must be '# pace log 1'"),
        (("POLICY", "nowhere.log"), "nowhere.log cannot be read: "),
    ],
)
def test_wrong_input_is_one_line(
    file: Path, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any, arguments: Any, words: str
) -> None:
    named = {"POLICY": str(file), "LOG": str(log)}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["pace retrace", *(named.get(argument, argument) for argument in arguments)])
    assert main() in (1, 2)
    error = capsys.readouterr().err
    assert words in error
    assert len(error.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_log_is_read_as_it_was_written(tmp_path: Path) -> None:
    path, sizes = tmp_path / "a.log", {"gyro": 3, "age": 1}
    written = Log(path, sizes, 2)
    written.add(0.0, {"gyro": [0.1, 1e-9, -3e7], "age": np.float32(0.004)}, [1.0, 2.0], restart=True)
    written.add(0.02, {"gyro": np.ones(3), "age": np.array([np.nan])}, np.zeros(2))
    written.close()
    found = read_log(path, {**sizes, "joint_target": 2})
    assert found["time"].tolist() == [0.0, 0.02]
    assert found["restart"].tolist() == [True, False]
    assert np.array_equal(found["gyro"][0].astype(np.float32), np.array([0.1, 1e-9, -3e7], np.float32))
    assert np.isnan(found["age"][1, 0])
    text = path.read_text()
    for broken, words in (
        (text.replace("gyro.1", "gyro.9"), "has no column gyro.1"),
        (text + "0.04,0,1,2\n", "line 5: a number is missing"),
        (text.replace("0.020000", "soon"), "line 4: a number is missing, or is none"),
        ("\n".join(text.splitlines()[:2]), "has no rows"),
        (text.replace("gyro.1", "gyro.0"), "has more than one column gyro.0"),
    ):
        path.write_text(broken)
        with pytest.raises(ValueError, match=words):
            read_log(path, {**sizes, "joint_target": 2})
