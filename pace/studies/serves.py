"""The balls of ``serve=machine``: where they land, how fast and high they fly, and how they spin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from pace.config.ball import TableConfig
from pace.config.task import SPINS
from pace.config.training import load_train_config
from pace.runs.metrics import markdown
from pace.sim.ball.aero import GRAVITY
from pace.sim.ball.ball import BallParams, BallSim
from pace.studies.common import COLOURS
from pace.task.resets import ServeSampler

COUNT = 100_000
SEED = 0
QUANTILES = (0.05, 0.5, 0.95)


@dataclass(frozen=True)
class Machine:
    """``COUNT`` balls by name, each quantity (M,): of the good ones, those that land as ``serve=machine`` asks for."""

    values: dict[str, Tensor]
    bad: float  # share of balls that still land otherwise
    court: TableConfig


def sample() -> Machine:
    """Sample and forecast the balls, on a CPU."""
    config = load_train_config(["serve=machine"])
    own, dt = config.ball, config.engine.ball_dt
    ball = BallSim(COUNT, "cpu", BallParams.from_config(own), own.table, config.robot.control_dt, 1, dt, own.air)
    sampler = ServeSampler(config.serve, ball, torch.Generator().manual_seed(SEED))
    everyone = torch.ones(COUNT, dtype=torch.bool)
    position, velocity, spin = sampler.sample(everyone)
    ball.forecast(everyone, position, velocity, spin, config.reward.target_x)
    good, flight = sampler.accepted.clone(), ball.forecast_result
    rise = velocity[:, 2].clamp(min=0.0)
    values = {
        "bounce x (m)": flight.bounce[:, 0],
        "bounce y (m)": flight.bounce[:, 1],
        "speed (m/s)": velocity.norm(dim=1),
        "elevation (degrees)": torch.rad2deg(torch.atan2(velocity[:, 2], velocity[:, :2].norm(dim=1))),
        "highest point before the bounce (m)": position[:, 2] + 0.5 * rise.square() / GRAVITY,
        "apex after the bounce (m)": flight.apex[:, 2],
        "time to the bounce (s)": flight.bounce_time,
    }
    values |= {f"{name} (rad/s)": sampler.about[:, column] for column, name in enumerate(SPINS)}
    kept = {name: value[good] for name, value in values.items()}
    return Machine(kept, float((~good).float().mean()), own.table)


def table(found: Machine) -> str:
    """5, 50 and 95 % quantiles of each quantity as Markdown."""
    rows = []
    for name, value in found.values.items():
        known = value[~value.isnan()].numpy()
        rows.append([name, *(f"{quantile:.2f}" for quantile in np.quantile(known, QUANTILES))])
    return markdown(("quantity", "5 %", "50 %", "95 %"), rows)


def draw(found: Machine, figure: Figure) -> None:
    """Landing points on the robot's half, and histograms of speed, heights and spin."""
    landing, *panels = figure.subplots(1, 4)
    _draw_landing(landing, found)
    groups = (
        ["speed (m/s)"],
        ["highest point before the bounce (m)", "apex after the bounce (m)"],
        [f"{name} (rad/s)" for name in SPINS],
    )
    for axes, names in zip(panels, groups, strict=True):
        for colour, name in zip(COLOURS, names, strict=False):
            label, _, unit = name.partition(" (")
            axes.hist(found.values[name].numpy(), 40, density=True, histtype="step", color=colour, label=label)
            axes.set_xlabel(unit.rstrip(")"))
        axes.set_yticks([])
        axes.set_ylabel("density")
        axes.margins(y=0.35)
        axes.legend(frameon=False, loc="upper center", fontsize=8)


def _draw_landing(axes: Axes, found: Machine) -> None:
    x, y = (found.values[name].numpy() for name in ("bounce x (m)", "bounce y (m)"))
    length, width = 0.5 * found.court.length, 0.5 * found.court.width
    axes.hist2d(y, x, bins=(45, 40), range=((-width, width), (-length, 0.0)), cmap="Blues")
    axes.set_aspect("equal")
    axes.set_xlabel("bounce, y (m)")
    axes.set_ylabel("x (m); the net is at 0")
