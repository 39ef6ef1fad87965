"""A run as a folder: resolved configuration, versions and git state, metrics as CSV and TensorBoard, learning curve."""

from __future__ import annotations

import json
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pace.config.base import ConfigError
from pace.config.upgrade import FORMAT
from pace.runs.checkpoint import Checkpoint, CheckpointError, save_checkpoint
from pace.runs.checkpoint_folders import FOLDER, clear_leftovers, list_checkpoints, prune_checkpoints, update_of
from pace.runs.files import reason, say, write_whole
from pace.runs.learning_curve import CURVE
from pace.runs.metrics_file import EventsFile, MetricsFile
from pace.runs.own_files import listed, make_out, note, remove_unused, require_own
from pace.runs.tracker import Tracker, require_logger

STAMP = "# format: "  # begins the first line of a run's configuration
LOCK = ".lock"
CHECKPOINTS_KEPT = 4
REPLAYS, REPLAY_SUFFIX, MOST_REPLAYS = "replays", ".replay", 16
CONFIG, VERSIONS, METRICS, EVENTS = "config.yaml", "versions.json", "metrics.csv", "events"
FILM, EVALUATION = "play.mp4", "evaluation"  # of a training run that has come to its end
FILES = (CONFIG, VERSIONS, METRICS, CURVE)  # of every run
PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "mujoco-warp", "warp-lang", "numpy", "hydra-core")
LEFTOVER = re.compile(r"\.(config\.yaml|versions\.json|metrics\.csv)\.\d+\.tmp")  # of a kill while a file was written


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
    """Files of one run, owned by one process at a time.

    The folder is made and claimed at once; :meth:`begin` writes into it. Rows that a crashed run logged after
    ``first_update``, its last checkpoint, are dropped then.

    Args: path: ``None`` is a :func:`pace.runs.own_files.new_folder` of the configuration's ``name``. ``files``: names
    that the command writes there besides :data:`FILES`. ``logger``: of :data:`pace.runs.tracker.LOGGERS`; it goes on
    after :meth:`close`, until :meth:`finish`.
    Errors: :class:`ConfigError` for a logger that is not there, for a folder that cannot be made, that another process
    owns, or that holds a later checkpoint or somebody else's files of these names.
    """

    def __init__(
        self,
        path: str | Path | None,
        config: dict[str, Any],
        tensorboard: bool,
        first_update: int = 0,
        files: Sequence[str] = (),
        logger: str | None = None,
    ) -> None:
        require_logger(logger)
        self._made = path is None or not Path(path).exists()
        self.path = make_out(None if path is None else str(path), str(config.get("name", "")))
        self._config, self._first_update = config if path else config | {"out": str(self.path)}, first_update
        self._files = (*FILES, *files)
        self._require_own()
        self._lock = FileLock(self.path / LOCK)  # the system releases it when the process ends, for whatever reason
        self._claim()
        self._tensorboard, self._logger = tensorboard, logger
        self._tracker: Tracker | None = None
        self._metrics: MetricsFile | None = None
        self._events: EventsFile | None = None

    def _claim(self) -> None:
        """Own the folder, which must not hold a checkpoint that is newer than the run's."""
        try:
            self._lock.acquire(timeout=0)
        except Timeout as error:
            raise ConfigError(
                f"{self.path} is in use by another process: end that first, or give another out="
            ) from error
        except OSError as error:  # a file system without locks
            say(f"warning: {self.path} cannot be locked ({reason(error)}): do not train another run in it")
        last = max((update_of(folder) for folder in list_checkpoints(self.path)), default=0)
        if last > self._first_update:
            raise ConfigError(
                f"{self.path} has a checkpoint of update {last}: resume={self.path} continues it; "
                "or give another out=, or move it away"
            )

    def _require_own(self) -> None:
        """The files that a run replaces must be a run's. Errors: :class:`ConfigError` for somebody else's."""
        if is_run(self.path) and CONFIG not in listed(self.path):
            return  # of before there was a list
        require_own(self.path, self._files)

    def configure(self, config: dict[str, Any]) -> None:
        """Replace the configuration that :meth:`begin` writes, by what became known since the folder was made."""
        self._config = config

    def begin(self) -> None:
        """Write configuration and versions, and open the logs; :meth:`log` does so if this was not called.

        Errors: :class:`ConfigError` for files that cannot be written.
        """
        if self._metrics is not None:
            return
        try:
            clear_leftovers(self.path)
            for file in self.path.iterdir():
                if LEFTOVER.fullmatch(file.name):
                    file.unlink()
            self._describe()
            self._metrics = MetricsFile(self.path / METRICS, self._first_update)
        except OSError as error:
            raise ConfigError(f"{error.filename or self.path} cannot be written: {reason(error)}") from error
        if self._tensorboard:
            first = self._metrics.samples + 1 if self._first_update else 0
            self._events = EventsFile(self.path / EVENTS, first)
        if self._logger is not None:
            self._tracker = Tracker(self.path, self._config)

    def _describe(self) -> None:
        """Write configuration and versions, and note all names as the run's own."""
        note(self.path, self._files)
        write_whole(self.path / CONFIG, f"{STAMP}{FORMAT}\n{OmegaConf.to_yaml(OmegaConf.create(self._config))}")
        write_whole(self.path / VERSIONS, json.dumps(versions(), indent=1))

    @property
    def metrics_file(self) -> Path:
        """The CSV of metrics, one row per update."""
        return self.path / METRICS

    def log(self, row: dict[str, float]) -> None:
        """Append one row to the logs. NaN is an empty cell. A log that cannot be written waits, and says so."""
        self.begin()
        self.restore()
        assert self._metrics is not None  # begin() opened it
        self._metrics.add(row)
        for log in (self._events, self._tracker):
            if log is not None:
                log.add(row)

    def save(self, update: int, checkpoint: Checkpoint, last: bool = False) -> Path | None:
        """Write the checkpoint of an update, and delete old ones; returns its folder.

        One that cannot be written is told, and None: the run goes on, and the next one may fit.

        Errors: :class:`CheckpointError` if the ``last`` one of the run cannot be written.
        """
        self.restore()
        try:
            folder = save_checkpoint(self.path / FOLDER / f"update_{update:08d}", checkpoint)
        except CheckpointError as error:
            if last:
                raise
            say(f"warning: {error}; training goes on, the last checkpoint stays")
            return None
        prune_checkpoints(self.path, CHECKPOINTS_KEPT)
        return folder

    def save_replay(self, update: int, write: Callable[[Path], Path]) -> None:
        """Let ``write`` make the file of a replay; only the first :data:`MOST_REPLAYS` of a run are kept."""
        folder = self.path / REPLAYS
        if folder.is_dir() and len(list(folder.iterdir())) >= MOST_REPLAYS:
            return
        file = folder / f"update_{update:08d}{REPLAY_SUFFIX}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            say(f"warning: numbers went wrong in update {update}; pace play {write(file)} shows the last steps")
        except OSError as error:
            say(f"warning: {file} cannot be written: {reason(error)}")

    def restore(self) -> None:
        """Make the folder again if it was deleted under the run, and say so. What was in it is lost."""
        if self.path.exists():
            return
        say(f"warning: {self.path} was deleted: the run makes it again and goes on")
        with suppress(OSError):  # the next file that is written there says why
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock.release(force=True)
            with suppress(Timeout):
                self._lock.acquire(timeout=0)
            self._describe()

    def close(self) -> None:
        """Close the logs, and release the folder."""
        for log in (self._metrics, self._events):
            if log is not None:
                log.close()
        self._lock.release()

    @property
    def is_tracked(self) -> bool:
        """Whether a logger takes files at the end."""
        return self._tracker is not None

    def finish(self, files: Sequence[Path] = ()) -> None:
        """Hand those of the files that are there to the logger, if there is one, and finish it."""
        if self._tracker is not None:
            tracker, self._tracker = self._tracker, None
            tracker.upload(files)
            tracker.close()

    def abandon(self) -> None:
        """Release the folder of a run that could not start; a new one is removed."""
        self.close()
        self.finish()
        if self._made and self._metrics is None:
            remove_unused(self.path, (LOCK,))


def is_run(folder: Path) -> bool:
    """Whether a run wrote ``folder``, by its configuration."""
    config = folder / CONFIG
    return config.is_file() and (_first_line(config).startswith(STAMP) or {"robot", "algo"} <= set(_keys(config)))


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
        with file.open(encoding="utf-8") as text:
            return text.readline()
    except (OSError, UnicodeDecodeError):
        return ""
