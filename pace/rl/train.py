"""``python -m pace.rl.train``: train a policy and its predictor; the same as ``pace train``."""

from __future__ import annotations

import sys
from functools import partial
from typing import TYPE_CHECKING

from pace.command import run_command

if TYPE_CHECKING:
    from pathlib import Path

    from omegaconf import DictConfig

    from pace.config.judge import JudgeConfig
    from pace.rl.judge import Judge

main = partial(run_command, "train")


def train_from_config(composed: DictConfig) -> None:
    """Train as the composed configuration says; judge the run while it trains and at its end, film and export it."""
    from pace.rl.session import train_from_config as train  # torch takes seconds to load

    train(composed, _judge, _film, _export)


def _judge(config: JudgeConfig) -> Judge:
    from pace.evaluation.judge import RunJudge  # one process of a run needs it

    return RunJudge(config)


def _film(run: Path, seconds: float) -> None:
    """Film the newest policy of ``run`` for so long, s, or say what is missing for that."""
    from pace.runs.files import tell
    from pace.runs.run_folder import FILM
    from pace.sim.render import RenderError
    from pace.viewer.play import film_run

    file = run / FILM
    try:
        film_run(run, file, seconds)
    except RenderError as error:
        tell(f"no video: {error}")
    else:
        tell(f"wrote {file}")


def _export(run: Path) -> None:
    """Export the newest policy of ``run`` into its folder, or say what is missing for that."""
    from pace.deploy.export import ExportError, export_run
    from pace.runs.files import tell

    try:
        file = export_run(run)
    except ExportError as error:
        tell(f"no ONNX file: {error}")
    else:
        tell(f"wrote {file}")


if __name__ == "__main__":
    sys.exit(main())
