"""The reference player: an exported policy behind its contract, in plain Python, for the robot's own computer.

Needs numpy and onnxruntime, and nothing of PACE: copy this one file. :class:`Controller` loads ``policy.onnx`` with the
``policy.json`` beside it, and is called once a control step; :class:`Log` records what it read and gave
(``pace retrace`` reads that).
"""

from __future__ import annotations

import csv
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

#: Of the file's metadata. 4: one frame of readings, with the ball's age but not its launch, and one state; 5: the age
#: of the base.
FORMAT = 5
CONTRACT = 1  # version of the contract that is understood here
LOG = "# pace log 1"  # first line of a log
#: Keys of the file's metadata that the contract repeats.
SHARED = (
    "format", "procedure", "joint_names", "nominal_pose", "joint_range", "kp", "kd", "effort", "max_speed",
    "stall_torque", "action_scale", "action_clip", "control_dt", "inputs", "outputs", "sensing", "actuator_delay",
    "source",
)  # fmt: skip

Vector = np.ndarray
Frame = dict[str, np.ndarray]


class Controller:
    """The exported policy: one call a control step, from the sensors' current readings to joint targets.

    Attributes: ``contract`` the content of ``policy.json``; ``meta`` the file's own metadata; ``control_dt`` s between
    calls; ``sizes`` of the readings by name; ``outputs`` of the last call by name.

    Args: file: ``policy.onnx``. joints: the robot's own joints in the order of its drivers; ``None`` is not checked.

    Errors: ``ValueError``, in one line, for a file that cannot be read or has no contract, a contract of another
    version or of another file, one that does not fit ``joints``, and if the contract's examples do not come out.
    """

    def __init__(self, file: str | Path, joints: Sequence[str] | None = None) -> None:
        file = Path(file)
        self._session = _open(file)
        stored = self._session.get_modelmeta().custom_metadata_map
        if "format" not in stored:
            raise ValueError("no policy that PACE exported")
        if stored["format"] != str(FORMAT):
            raise ValueError(f"format {stored['format']}, not {FORMAT}: export it again with this version of PACE")
        self.meta = {name: json.loads(value) for name, value in stored.items()}
        self.contract = read_contract(file, self.meta)
        if joints is not None:
            check_joints(self.contract["joint_names"], joints)
        self._names = [output.name for output in self._session.get_outputs()]
        self.control_dt = float(self.contract["control_dt"])
        self.outputs: Frame = {}
        self.sizes = {name: port["size"] for name, port in self.contract["inputs"].items() if name != "state"}
        self._state_size = self.contract["inputs"]["state"]["size"]
        self.restart()
        self.verify()

    def restart(self) -> None:
        """Start from scratch, without earlier returns: after a fall, with another paddle, not with every ball."""
        self._state = np.zeros((1, self._state_size), dtype=np.float32)

    def __call__(self, readings: Mapping[str, Any]) -> Vector:
        """Joint targets (J,) rad, in the order of ``contract["joint_names"]``.

        Args: readings: the sensed inputs by name (``contract["inputs"]`` describes them), each of its own size.

        Errors: ``ValueError``, in one line, for a reading that is missing, unknown, of another size or not finite, and
        for targets that are not finite. The state then stays that of the call before, so that the next one goes on.
        """
        for name in sorted(self.sizes.keys() ^ readings.keys(), key=str):
            raise ValueError(f"the reading {name} is {'missing' if name in self.sizes else 'no input of the file'}")
        frame = {name: _reading(name, readings[name], size)[None] for name, size in self.sizes.items()}
        values = self._session.run(self._names, frame | {"state": self._state})
        outputs = {name: np.asarray(value)[0] for name, value in zip(self._names, values, strict=True)}
        if not all(np.isfinite(value).all() for value in outputs.values()):
            raise ValueError("the readings are beyond all sense: what follows from them is not finite")
        self.outputs = outputs
        self._state = outputs["state_next"][None]
        return outputs["joint_target"]

    def verify(self) -> float:
        """Play the contract's examples, and return the largest difference of a target, rad; then start from scratch.

        Errors: ``ValueError`` for a difference above the contract's tolerance, and for examples that are no readings.
        """
        tolerance, rows = _examples(self.contract.get("examples"), self.sizes, len(self.contract["joint_names"]))
        self.restart()
        largest = 0.0
        for index, row in enumerate(rows):
            target = row.pop("joint_target")
            difference = float(np.abs(self(row) - target).max())
            if not difference <= tolerance:
                raise ValueError(
                    f"the contract's example {index} gives targets that differ by {difference:.2g} rad, more than "
                    f"{tolerance:g}: another build of onnxruntime, or a contract that was changed"
                )
            largest = max(largest, difference)
        self.restart()
        self.outputs = {}
        return largest


def _open(file: Path) -> Any:
    """The file in onnxruntime, on one thread. Errors: ``ValueError`` for one that it cannot read."""
    import onnxruntime
    import onnxruntime.capi.onnxruntime_pybind11_state as ort  # type: ignore[import-not-found]

    # errors of a file that cannot be read; they have no common class
    unreadable = (
        ort.NoSuchFile,
        ort.InvalidProtobuf,
        ort.InvalidGraph,
        ort.InvalidArgument,
        ort.NotImplemented,
        ort.Fail,
    )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except unreadable as error:
        raise ValueError(str(error).splitlines()[0]) from error


def read_contract(file: Path, stored: Mapping[str, Any]) -> dict[str, Any]:
    """The contract of ``file``, whose own metadata is ``stored``.

    Errors: ``ValueError``, in one line, if it is missing, broken, of another version or not of this file.
    """
    beside = file.with_suffix(".json")
    try:
        found = json.loads(beside.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        what = "is missing" if isinstance(error, FileNotFoundError) else "cannot be read"
        raise ValueError(f"its contract {beside.name} {what}: pace export writes both") from error
    version = found.get("contract") if isinstance(found, dict) else None
    if version != CONTRACT or isinstance(version, bool):
        raise ValueError(f"contract {version!r}, not {CONTRACT}: export it again with this version of PACE"[:200])
    if found.get("sha256") != hashlib.sha256(file.read_bytes()).hexdigest():
        raise ValueError(f"{beside.name} is the contract of another file: its sha256 is not that of {file.name}")
    for key in SHARED:
        if json.dumps(found.get(key)) != json.dumps(stored[key]):
            raise ValueError(f"the contract's {key} is not that of the file: pace export writes both")
    return found


def check_joints(wanted: Sequence[str], own: Sequence[str]) -> None:
    """Errors: ``ValueError`` unless the robot's ``own`` joints are those of the policy, in their order."""
    for index, (mine, name) in enumerate(zip(own, wanted, strict=False)):
        if mine != name:
            raise ValueError(f"joint {index} of the robot is {mine}, of the policy {name}: order them as joint_names")
    if len(own) != len(wanted):
        raise ValueError(f"the robot has {len(own)} joints, the policy {len(wanted)}: order them as joint_names")


def _examples(given: Any, sizes: Mapping[str, int], joints: int) -> tuple[float, list[Frame]]:
    """Tolerance and rows of the contract's examples, ``joint_target`` among the readings. Errors: ``ValueError``."""
    readings = given.get("readings") if isinstance(given, dict) else None
    if not isinstance(readings, dict) or readings.keys() != sizes.keys():
        raise ValueError("the contract's examples.readings must have all readings")
    tolerance, parts = given.get("tolerance"), {**readings, "joint_target": given.get("joint_target")}
    if not isinstance(tolerance, float) or not 0.0 < tolerance < 1.0:
        raise ValueError("the contract's examples.tolerance must be a number of rad between 0 and 1")
    counts = {len(values) if isinstance(values, list) else 0 for values in parts.values()}
    if len(counts) != 1 or not max(counts):
        raise ValueError("the contract's examples must have a row a step for each reading and for joint_target")
    widths = {**sizes, "joint_target": joints}
    rows = range(max(counts))
    return tolerance, [{name: _reading(name, parts[name][row], size) for name, size in widths.items()} for row in rows]


def _reading(name: str, value: object, size: int) -> Vector:
    """``value`` as a float32 vector of ``size`` finite numbers. Errors: ``ValueError``."""
    try:
        with np.errstate(over="ignore"):  # becomes infinite, which is refused below
            vector = np.asarray(value).astype(np.float32, casting="same_kind")
    except (TypeError, ValueError):  # text, numbers of another kind, lists of different lengths
        vector = np.empty(0, dtype=np.float32)
    if vector.shape != (size,):
        raise ValueError(f"the reading {name} must be a vector of {size} numbers")
    if not np.isfinite(vector).all():
        raise ValueError(f"the reading {name} is not finite")
    return vector


class Log:
    """A log of control steps, as text: the line :data:`LOG`, names of the columns, then a row a step.

    Columns: ``time`` s; ``restart`` 1 if the state was zero before the step; each reading and ``joint_target`` as the
    file gave it, before the robot's safety layer, number by number (``ball_position.0``).

    Args: file: that is written; sizes: numbers of each reading by name, in the order of the columns; joints: J.
    """

    def __init__(self, file: str | Path, sizes: Mapping[str, int], joints: int) -> None:
        self._sizes = {**sizes, "joint_target": joints}
        self._file = Path(file).open("w", encoding="utf-8", newline="")  # noqa: SIM115  closed by close()
        self._file.write(f"{LOG}\n")
        self._rows = csv.writer(self._file, lineterminator="\n")
        self._rows.writerow(["time", "restart", *columns(self._sizes)])

    def add(self, time: float, readings: Mapping[str, Any], target: Any, restart: bool = False) -> None:
        """One control step: s, readings by name, and the targets (J,) rad that the file gave."""
        values = {**readings, "joint_target": target}
        numbers = np.concatenate([np.ravel(np.asarray(values[name], dtype=np.float32)) for name in self._sizes])
        self._rows.writerow([f"{time:.6f}", int(restart), *(repr(float(f"{value:.9g}")) for value in numbers)])

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def columns(sizes: Mapping[str, int]) -> list[str]:
    """Names of the columns of a log, for readings of these sizes."""
    return [f"{name}.{index}" for name, size in sizes.items() for index in range(size)]


def read_log(file: str | Path, sizes: Mapping[str, int]) -> dict[str, Vector]:
    """Columns of a log: ``time`` (M,) s, ``restart`` (M,) bool, and each of ``sizes`` (M, size).

    Errors: ``OSError``; ``ValueError``, in one line, for a file that is no log, with other columns or a broken row.
    """
    with Path(file).open(encoding="utf-8", errors="replace", newline="") as text:
        if text.readline().rstrip() != LOG:
            raise ValueError(f"{file} is no log: its first line must be '{LOG}'")
        rows = list(csv.reader(text))
    wanted = ["time", "restart", *columns(sizes)]
    head = rows[0] if rows else []
    for name in wanted:
        if head.count(name) != 1:
            raise ValueError(f"{file} has {'no' if name not in head else 'more than one'} column {name}")
    where = [head.index(name) for name in wanted]
    table = np.array([_numbers(file, number, row, where) for number, row in enumerate(rows[1:], start=3)])
    if not len(table):
        raise ValueError(f"{file} has no rows")
    found, start = {"time": table[:, 0], "restart": table[:, 1] > 0.5}, 2
    for name, size in sizes.items():
        found[name] = table[:, start : start + size]
        start += size
    return found


def _numbers(file: str | Path, line: int, row: Sequence[str], where: Sequence[int]) -> list[float]:
    try:
        return [float(row[index] or math.nan) for index in where]
    except (IndexError, ValueError) as error:
        raise ValueError(f"{file}, line {line}: a number is missing, or is none") from error
