"""Weights & Biases: the rows of a run, and its files at the end (``logger=wandb``, extra ``wandb``).

``WANDB_MODE=offline`` needs no network: ``wandb sync`` of the folder ``wandb/`` in the run uploads it later.
"""

from __future__ import annotations

import math
import os
import secrets
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pace.config.base import ConfigError
from pace.config.extras import cure
from pace.runs.files import say, write_whole

LOGGERS = ("wandb",)
IDENTITY = ".wandb_id"  # in the run folder: a run that resumes goes on in the same run of wandb
PROJECT = "pace"  # unless WANDB_PROJECT says another
VIDEOS, FIGURES = (".mp4",), (".png",)


def require_logger(logger: str | None) -> None:
    """Errors: :class:`ConfigError` for an unknown logger, and for one whose package is missing."""
    if logger is None:
        return
    if logger not in LOGGERS:
        raise ConfigError(f"logger must be null or {', '.join(LOGGERS)}, not {logger!r} (tensorboard=true is apart)")
    if find_spec("wandb") is None:
        raise ConfigError(f"logger=wandb needs the package wandb: {cure('wandb')}")


class Tracker:
    """One run of Weights & Biases, which the folder ``path`` belongs to.

    Args: path: the run folder; config: of the run, plain.

    Errors: :class:`ConfigError` if wandb cannot begin, for example without a key for its server.
    """

    def __init__(self, path: Path, config: Mapping[str, Any]) -> None:
        import wandb  # type: ignore[import-not-found]  # an extra

        self._wandb = wandb
        try:
            self._run = wandb.init(
                dir=str(path),
                name=path.name,
                id=_identity(path),
                resume="allow",
                project=os.environ.get("WANDB_PROJECT", PROJECT),
                config=dict(config),
                settings=wandb.Settings(console="off"),
            )
        except (wandb.Error, OSError) as error:
            cause = " ".join(str(error).split())
            raise ConfigError(f"logger=wandb: {cause} (wandb login, or WANDB_MODE=offline, helps)") from error
        self._run.define_metric("*", step_metric="samples")

    def add(self, row: Mapping[str, float]) -> None:
        """Log one row, over its ``samples``. NaN is left out."""
        self._run.log({name: value for name, value in row.items() if not math.isnan(value)})

    def upload(self, files: Sequence[Path]) -> None:
        """Upload videos and figures as media, and the other files as an artifact of the type ``model``."""
        there = [file for file in files if file.is_file()]
        media = {file.stem: self._wandb.Video(str(file), format="mp4") for file in there if file.suffix in VIDEOS}
        media |= {file.stem: self._wandb.Image(str(file)) for file in there if file.suffix in FIGURES}
        if media:
            self._run.log(media)
        others = [file for file in there if file.suffix not in (*VIDEOS, *FIGURES)]
        if others:
            artifact = self._wandb.Artifact(f"policy-{self._run.id}", type="model")
            for file in others:
                artifact.add_file(str(file))
            self._run.log_artifact(artifact)
        if there:
            say(f"wandb: {', '.join(file.name for file in there)}")

    def close(self) -> None:
        """Finish the run of wandb, which sends what is left."""
        self._run.finish()


def _identity(path: Path) -> str:
    """The run's name in wandb's database, which is kept in its folder."""
    file = path / IDENTITY
    if not file.exists():
        write_whole(file, f"{secrets.token_hex(8)}\n")
    return file.read_text(encoding="utf-8").strip()
