"""Error bounds for the apex of a serve, and the errors of predictors, by time before the apex."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from pace.config.base import compose, parse
from pace.config.training import TrainConfig
from pace.evaluation.report import bin_label
from pace.predictor.regression import BIN_NAMES, TIME_BINS
from pace.rl.policies import load_predictor
from pace.runs.metrics import markdown
from pace.studies.common import COLOURS
from pace.studies.flights import Recording, record
from pace.studies.posterior import Question, answer

FRAMES = 46  # control steps, 0.9 s: past the apex of every serve
CHAINS, STEPS = 4, 900
SEED = 5
#: Number of the last sensed positions behind each bound.
WINDOWS = {"bound, five positions": 5, "bound, whole flight": FRAMES}
#: Name -> ball preset, randomisation, sensing and serves.
CASES = {
    "rubber": ("rubber", "moderate", "paper", "mixed"),
    "paper": ("paper", "moderate", "paper", "mixed"),
    "standard": ("standard", "moderate", "paper", "mixed"),
    "venue": ("venue", "moderate", "paper", "mixed"),
    "all (wide)": ("rubber", "wide", "paper", "mixed"),
    "paper, as published": ("paper", "paper", "paper", "mixed"),
    "rubber, ball known": ("rubber", "none", "paper", "mixed"),
    "rubber, clean": ("rubber", "moderate", "clean", "mixed"),
    "paper, clean": ("paper", "moderate", "clean", "mixed"),
    "standard, clean": ("standard", "moderate", "clean", "mixed"),
    "venue, clean": ("venue", "moderate", "clean", "mixed"),
    "rubber, ball known, clean": ("rubber", "none", "clean", "mixed"),
    "rubber, machine": ("rubber", "moderate", "paper", "machine"),
    "rubber, machine, ball known": ("rubber", "none", "paper", "machine"),
}
SHOWN = ("rubber", "rubber, ball known")
BEFORE_APEX = BIN_NAMES[1:]


@dataclass(frozen=True)
class Errors:
    """RMSE of the apex (3-D, cm) of each bound and predictor, by ``BEFORE_APEX``, NaN for bins without a serve."""

    case: str
    rmse: dict[str, list[float]]


def case_config(case: str, serves: int) -> TrainConfig:
    """The task of ``CASES[case]``."""
    ball, randomization, sensing, serve = CASES[case]
    overrides = [f"ball={ball}", f"randomization={randomization}", f"sensing={sensing}", f"serve={serve}"]
    return parse(compose("predictor_train", [*overrides, f"num_worlds={serves}", f"seed={SEED}"]), TrainConfig)


def compare(case: str, serves: int, runs: Sequence[Path] = ()) -> Errors:
    """Bounds and the predictors of ``runs``, at the same instant of each of ``serves`` serves in each bin."""
    config = case_config(case, serves)
    recording = record(config, FRAMES)
    instants = instants_of(recording)
    rmse = {name: [_bound(config, recording, at, frames) for at in instants] for name, frames in WINDOWS.items()}
    return Errors(case, rmse | {run.name: predicted_rmse(case, serves, run, instants) for run in runs})


@torch.no_grad()
def predicted_rmse(case: str, serves: int, run: Path, instants: Sequence[Tensor]) -> list[float]:
    """RMSE (cm) of a saved predictor by ``BEFORE_APEX``, at ``instants`` of the serves that :func:`compare` plays."""
    predictor = load_predictor(run)
    config = dataclasses.replace(case_config(case, serves), predictor=predictor.config)
    recording = record(config, FRAMES, predictor.network)
    error = recording.predicted - recording.apex.unsqueeze(1)
    return [_rmse(error[at >= 0, at[at >= 0]]) for at in instants]


def _bins(recording: Recording) -> Tensor:
    return torch.bucketize(recording.time_to_apex.contiguous(), torch.tensor(TIME_BINS), right=True)


def instants_of(recording: Recording) -> list[Tensor]:
    """For each of ``BEFORE_APEX`` a random control step of every serve (N,) in that bin; -1 if it has none."""
    generator = torch.Generator().manual_seed(SEED)
    bins = _bins(recording)
    found = []
    for number in range(1, len(BIN_NAMES)):
        suits = recording.valid & (bins == number)
        priority = torch.rand(suits.shape, generator=generator) * suits
        found.append(torch.where(suits.any(1), priority.argmax(1), -1))
    return found


def _bound(config: TrainConfig, recording: Recording, instants: Tensor, frames: int) -> float:
    """RMSE of the posterior mean from the last ``frames`` positions at ``instants`` (N,)."""
    chosen = instants >= 0
    if not chosen.any():
        return float("nan")
    now = instants[chosen].unsqueeze(1)
    step = torch.arange(int(now.max()) + 1)
    used = (step <= now) & (step > now - frames)
    question = Question(recording.cube[chosen], recording.sensed[chosen, : len(step)], used)
    return _rmse(answer(config, question, CHAINS, STEPS).mean - recording.apex[chosen])


def _rmse(error: Tensor) -> float:
    return 100.0 * float(error.square().sum(1).mean().sqrt()) if len(error) else float("nan")


def table(found: Sequence[Errors]) -> str:
    """A row for each case and bound or predictor."""
    bins = [bin_label(name).replace("s", " s") for name in BEFORE_APEX]
    rows = [
        [errors.case, name, *(f"{value:.2f}" for value in values)]
        for errors in found
        for name, values in errors.rmse.items()
    ]
    return markdown(["ball", "RMSE (cm) before the apex", *bins], rows)


def draw(found: Sequence[Errors], figure: Figure) -> None:
    """RMSE over the time before the apex in the cases of SHOWN."""
    middle = np.array([0.05, 0.15, 0.25, 0.35, 0.5])
    shown = [errors for errors in found if errors.case in SHOWN] or list(found[:1])
    panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for axes, errors in zip(panels, shown, strict=True):
        for (name, values), colour in zip(errors.rmse.items(), COLOURS, strict=False):
            style = "--" if name in WINDOWS else "o-"
            axes.plot(middle, values, style, color=colour, lw=1.5, ms=4, label=name)
        axes.set(xlabel="time before the apex (s)", title=errors.case, ylim=(0, None))
        axes.invert_xaxis()
    panels[0].set_ylabel("RMSE of the apex (cm)")
    panels[0].legend(frameon=False, fontsize=8)
