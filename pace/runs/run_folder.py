"""A run as a folder: resolved configuration, versions and git state, metrics as CSV and TensorBoard, learning curve."""

from __future__ import annotations

import csv
import json
import math
import platform
import subprocess
import sys
import tempfile
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torchrl.record.loggers.tensorboard import TensorboardLogger

from pace.config.base import ConfigError
from pace.config.upgrade import FORMAT
from pace.runs.checkpoint import list_checkpoints
from pace.runs.metrics import read_metrics

STAMP = "# format: "  # begins the first line of a run's configuration
LOCK = ".lock"
CONFIG, VERSIONS, METRICS, CURVE = "config.yaml", "versions.json", "metrics.csv", "learning_curve.png"
PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "mujoco-warp", "warp-lang", "numpy", "hydra-core")
LEADING = (
    "update", "samples", "wall_s", "samples_per_s", "hit_rate", "success_rate", "fall_rate", "predictor_rmse_cm",
    "mean_reward", "kl", "lr", "policy_std",
)  # fmt: skip
CURVE_WINDOW = 40  # rows of the moving average in the plot


def default_folder(name: str) -> Path:
    """``runs/<date>_<name>``, with a number if that exists already."""
    base = Path("runs") / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}_{name}"
    candidate, number = base, 2
    while candidate.exists():
        candidate, number = base.with_name(f"{base.name}_{number}"), number + 1
    return candidate


def make_out(out: str | None, name: str) -> Path:
    """The folder that a command writes: ``out``, or a new :func:`default_folder`. Made before the work begins.

    Errors: :class:`ConfigError` for one that cannot be made or written.
    """
    folder = Path(out) if out else default_folder(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"out={folder} cannot be made: {error.strerror}") from error
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ConfigError(f"out={folder} cannot be written: {error.strerror}") from error
    return folder


def versions() -> dict[str, Any]:
    """Versions of the dependencies, the machine, the command line and the state of the git checkout."""
    packages: dict[str, str | None] = {}
    for package in (*PACKAGES, "pace-table-tennis"):
        try:
            packages[package] = version(package)
        except PackageNotFoundError:
            packages[package] = None
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "command": sys.argv,
        "packages": packages,
        "git": git_state(Path(__file__).resolve().parent),
    }


def git_state(folder: Path) -> dict[str, Any] | None:
    """Commit of the checkout around ``folder``, and whether it has uncommitted changes; None outside of git."""

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=20)
        except (FileNotFoundError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    commit, changes = git("rev-parse", "HEAD"), git("status", "--porcelain")
    if commit is None:
        return None
    return {"commit": commit, "dirty": bool(changes), "changes": (changes or "").splitlines()}


class RunFolder:
    """Files of one run, owned by one process at a time. Rows that a crashed run logged after ``first_update``, its last
    checkpoint, are dropped.

    Errors: :class:`ConfigError` for a folder that cannot be made, that another process owns, or that holds a later
    checkpoint.
    """

    def __init__(self, path: str | Path, config: dict[str, Any], tensorboard: bool, first_update: int = 0) -> None:
        self.path = Path(path)
        self._claim(first_update)
        (self.path / CONFIG).write_text(f"{STAMP}{FORMAT}\n{OmegaConf.to_yaml(OmegaConf.create(config))}")
        (self.path / VERSIONS).write_text(json.dumps(versions(), indent=1))
        self._columns: list[str] = []
        self._file = self._open_metrics(first_update)
        self._board = TensorboardLogger("events", str(self.path)) if tensorboard else None

    def _claim(self, first_update: int) -> None:
        """Make the folder, which must not hold a checkpoint that is newer than the run's."""
        make_out(str(self.path), "")
        self._lock = FileLock(self.path / LOCK)  # the system releases it when the process ends, for whatever reason
        try:
            self._lock.acquire(timeout=0)
        except Timeout as error:
            raise ConfigError(
                f"{self.path} is in use by another process: end that first, or give another out="
            ) from error
        self._require_own()
        last = max((int(folder.name.removeprefix("update_")) for folder in list_checkpoints(self.path)), default=0)
        if last > first_update:
            raise ConfigError(
                f"{self.path} has a checkpoint of update {last}: resume={self.path} continues it; "
                "or give another out=, or move it away"
            )

    def _require_own(self) -> None:
        """The files that a run replaces must be a run's. Errors: :class:`ConfigError` for somebody else's."""
        config, metrics = self.path / CONFIG, self.path / METRICS
        ours = [
            not config.exists() or _first_line(config).startswith(STAMP) or {"robot", "algo"} <= set(_keys(config)),
            not metrics.exists() or metrics.stat().st_size == 0 or _first_line(metrics).startswith("update,"),
        ]
        for file, own in zip((config, metrics), ours, strict=True):
            if not own:
                raise ConfigError(f"{file} is no file of a run, and is not replaced: give another out=")

    @property
    def metrics_file(self) -> Path:
        """The CSV of metrics, one row per update."""
        return self.path / METRICS

    def _open_metrics(self, first_update: int) -> Any:
        kept: list[dict[str, str]] = []
        if self.metrics_file.exists():
            with self.metrics_file.open(newline="") as file:
                reader = csv.DictReader(file)
                kept = [row for row in reader if row["update"].isdigit() and int(row["update"]) <= first_update]
                self._columns = list(reader.fieldnames or [])
        file = self.metrics_file.open("w", newline="", buffering=1)
        if self._columns:
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(kept)
        return file

    def log(self, row: dict[str, float]) -> None:
        """Append one row; the columns are those of the first row. NaN is an empty cell."""
        writer = csv.DictWriter(self._file, self._columns, restval="", extrasaction="ignore")
        if not self._columns:
            self._columns = [*LEADING, *(name for name in row if name not in LEADING)]
            writer = csv.DictWriter(self._file, self._columns, restval="", extrasaction="ignore")
            writer.writeheader()
        writer.writerow({name: _cell(value) for name, value in row.items()})
        if self._board is not None:
            for name, value in row.items():
                if not math.isnan(value):
                    self._board.log_scalar(name, value, step=int(row["samples"]))

    def close(self) -> None:
        """Flush and close the logs, and release the folder."""
        self._file.close()
        self._lock.release()
        if self._board is not None:
            self._board.experiment.close()


def _cell(value: float) -> str:
    if math.isnan(value):
        return ""
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else f"{value:.6g}"


def moving_average(values: list[float], window: int) -> list[float]:
    """Mean of the last ``window`` values that are not NaN, at each position."""
    result: list[float] = []
    for end in range(1, len(values) + 1):
        recent = [value for value in values[max(0, end - window) : end] if not math.isnan(value)]
        result.append(sum(recent) / len(recent) if recent else math.nan)
    return result


def plot_learning_curve(run: str | Path) -> Path | None:
    """Draw ``learning_curve.png`` from the run's CSV; None when it has fewer than two rows."""
    from matplotlib.figure import Figure  # imported here: it takes a second that no training should wait for

    metrics = read_metrics(Path(run) / METRICS)
    if len(metrics.get("update", [])) < 2:
        return None
    millions = [samples / 1e6 for samples in metrics["samples"]]
    panels = (
        ("share of serves, %", (("hit_rate", "hits", 100.0), ("success_rate", "returns", 100.0))),
        ("falls per s", (("fall_rate", "falls", 1.0),)),
        ("predictor RMSE, cm", (("predictor_rmse_cm", "apex", 1.0),)),
        ("policy std", (("policy_std", "std", 1.0),)),
    )
    figure = Figure(figsize=(9, 10), layout="constrained")
    for axes, (label, curves) in zip(figure.subplots(len(panels), 1, sharex=True), panels, strict=True):
        for column, name, factor in curves:
            smooth = moving_average(metrics[column], CURVE_WINDOW)
            axes.plot(millions, [factor * value for value in smooth], label=name)
        axes.set_ylabel(label)
        axes.update_datalim(
            [(millions[0], 0.0)]
        )  # zero is in view, and the upper margin is a share of the whole height
        axes.autoscale_view()
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(loc="best")
    axes.set_xlabel(f"control steps, millions (mean of {CURVE_WINDOW} updates)")
    file = Path(run) / CURVE
    figure.savefig(file, dpi=110)
    return file


def _keys(file: Path) -> list[str]:
    """Top-level keys of a YAML file; none if it is no mapping."""
    try:
        loaded = OmegaConf.load(file)
    except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException):
        return []
    return [str(key) for key in loaded] if isinstance(loaded, DictConfig) else []


def _first_line(file: Path) -> str:
    """The first line of a text file; nothing if it is no text."""
    try:
        with file.open() as text:
            return text.readline()
    except UnicodeDecodeError:
        return ""
