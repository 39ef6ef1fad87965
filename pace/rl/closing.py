"""The end of a training run: what is printed, judged, filmed and exported."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pace.config.judge import JudgeConfig
from pace.rl.judge import Judge
from pace.rl.trainer import Summary
from pace.runs.files import tell
from pace.runs.learning_curve import CURVE
from pace.runs.progress import rate_texts
from pace.runs.run_folder import METRICS

#: Films the newest policy of a run for so long, s.
Film = Callable[[Path, float], None]
#: Exports the newest policy of a run into its folder.
Export = Callable[[Path], None]


def close(judge: Judge, film: Film | None, summary: Summary, config: JudgeConfig, export: Export | None = None) -> None:
    """Tell and show what a finished run does without exploration, and what may come next; Ctrl-C leaves it out."""
    run, minutes = summary.folder, summary.seconds / 60.0
    if minutes < config.after:
        return
    try:
        judge.last(run, minutes)
        if film is not None and config.video > 0.0:
            film(run, config.video)
        if export is not None:
            export(run)
    except KeyboardInterrupt:
        tell("left out; the run is complete")
    tell(f"next: pace play {run} | pace evaluate {run} | pace export {run} out=robot")


def report(summary: Summary) -> None:
    """Print how the run ended and which files it wrote."""
    folder = summary.folder
    tell(
        f"{summary.reason}: {summary.updates} updates, {summary.samples:,} samples, {summary.seconds / 60:.1f} min\n"
        f"last updates: {', '.join([*rate_texts(summary.rates), *summary.faults])}\n"
        f"wrote {summary.checkpoint}\n"
        f"wrote {folder / METRICS}" + (f"\nwrote {folder / CURVE}" if summary.curve else "")
    )
