"""Worlds made of plain tensors: events, forecasts and robot states are set by hand."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import torch

from pace.arrays.tensors import allocate
from pace.config.task import TaskConfig
from pace.config.training import load_train_config
from pace.sim.ball.ball import BallEvents, Forecast
from pace.task.game import Game
from pace.task.state import TaskState
from tests.helpers.robot import SPEC

CPU = torch.device("cpu")


@lru_cache
def config(*overrides: str) -> TaskConfig:
    """The default task with Hydra overrides; shared by the tests, so not to be changed."""
    return load_train_config(list(overrides))


def set_events(events: BallEvents, **times: float | tuple[float, ...]) -> None:
    """Ball events of a step: keyword = kind, value = its time or times in the step, s; the same in all worlds."""
    for name, tensor in vars(events).items():
        tensor.fill_(torch.inf if name.endswith("_time") else 0)
    for kind, given in times.items():
        given = given if isinstance(given, tuple) else (given,)
        getattr(events, kind).fill_(len(given))
        getattr(events, f"{kind}_time").fill_(min(given))


def set_serve(forecast: Forecast) -> None:
    """The forecast of a playable serve."""
    forecast.bounce_time.fill_(0.4)
    forecast.apex.copy_(torch.tensor([-1.4, 0.1, 1.1]))
    forecast.apex_time.fill_(0.6)
    forecast.intercept.copy_(torch.tensor([-1.6, 0.12, 1.05]))
    forecast.intercept_time.fill_(0.68)


def fake_ball(n: int) -> Any:
    """A ball in mid-serve, without a physics; far from the paddle."""
    forecast = allocate(Forecast, n, CPU)
    set_serve(forecast)
    return SimpleNamespace(
        num_worlds=n, device=CPU, position=torch.tensor([0.5, 0.0, 1.1]).repeat(n, 1),
        velocity=torch.tensor([-5.0, 0.1, 0.5]).repeat(n, 1), spin=torch.zeros(n, 3),
        events=allocate(BallEvents, n, CPU), forecast_result=forecast, nearest_paddle_distance=torch.ones(n),
        params=SimpleNamespace(radius=torch.full((n,), 0.02)),
    )  # fmt: skip


def fake_robot(n: int) -> Any:
    """A robot that stands still at (-1.8, 0.3), both feet down."""
    return SimpleNamespace(
        joint_position=torch.zeros(n, 21), joint_velocity=torch.zeros(n, 21), joint_acceleration=torch.zeros(n, 21),
        joint_torque=torch.zeros(n, 21), base_position=torch.tensor([-1.8, 0.3, 0.7]).repeat(n, 1),
        base_quat=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1), base_linear_velocity=torch.zeros(n, 3),
        base_angular_velocity=torch.zeros(n, 3), projected_gravity=torch.tensor([0.0, 0.0, -1.0]).repeat(n, 1),
        heading=torch.tensor([1.0, 0.0]).repeat(n, 1), paddle_position=torch.tensor([-1.6, -0.3, 1.0]).repeat(n, 1),
        paddle_normal=torch.tensor([1.0, 0.0, 0.0]).repeat(n, 1), paddle_velocity=torch.zeros(n, 3),
        foot_position=torch.tensor([[-1.8, 0.5, 0.0], [-1.8, 0.1, 0.0]]).repeat(n, 1, 1),
        foot_velocity=torch.zeros(n, 2, 3), foot_up=torch.tensor([0.0, 0.0, 1.0]).repeat(n, 2, 1),
        foot_force=torch.tensor([0.0, 0.0, 160.0]).repeat(n, 2, 1), body_contact=torch.zeros(n, 6),
        head_position=torch.tensor([-1.8, 0.3, 1.15]).repeat(n, 1),
    )  # fmt: skip


def fake_worlds(n: int) -> Any:
    """The attributes of :class:`pace.sim.worlds.Worlds` that the task reads."""
    return SimpleNamespace(
        num_worlds=n, device=CPU, control_dt=0.02, robot=fake_robot(n), ball=fake_ball(n),
        nominal=torch.linspace(-0.5, 0.5, 21), joint_lower=torch.full((21,), -1.0),
        joint_upper=torch.full((21,), 1.0), spec=SPEC, engine=SimpleNamespace(table_force=torch.zeros(n, 2, 2, 3)),
    )  # fmt: skip


def fake_game(n: int = 1, task: TaskConfig | None = None) -> tuple[Game, Any]:
    """A game in the middle of a playable serve, and its worlds."""
    worlds = fake_worlds(n)
    game = Game(task or config(), worlds.ball, worlds.robot.base_position, worlds.engine.table_force)
    game.start_serve(torch.ones(n, dtype=torch.bool))
    return game, worlds


def fake_state(n: int = 1, task: TaskConfig | None = None) -> TaskState:
    """A state in the middle of a playable serve."""
    game, worlds = fake_game(n, task)
    state = TaskState(worlds, game, torch.zeros(worlds.num_worlds))
    state.refresh()
    return state
