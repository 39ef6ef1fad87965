"""Structs of arrays that are declared once: what is allocated, and the kernels' struct."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Annotated, Any

import pytest
import torch
import warp as wp

from pace.arrays.tensors import Bool, Float, InfFloat, Int, NanVec3, Start, Vec2, allocate, named_tensors, struct_of
from pace.sim.ball.state import BallEvents, EventArrays, Forecast
from pace.task.game_state import GameArrays, GameState
from pace.task.outcome import Outcome


@dataclass(eq=False)
class Part:
    count: Annotated[Int, Start(7)]
    on: Annotated[Bool, Start(True)]


@dataclass(eq=False)
class Whole:
    part: Part
    angle: Annotated[Float, "joints"]
    up: Annotated[NanVec3, "feet"]
    place: Vec2
    time: InfFloat


@struct_of(Whole)
class WholeArrays:
    """As a kernel sees it."""


def test_shapes_types_and_first_values_are_those_declared() -> None:
    whole = allocate(Whole, 3, "cpu", joints=5, feet=2)
    assert whole.part.count.dtype == torch.int32
    assert whole.part.count.tolist() == [7, 7, 7]
    assert whole.part.on.tolist() == [True] * 3
    assert {name: tuple(tensor.shape) for name, tensor in named_tensors(whole).items()} == {
        "part.count": (3,), "part.on": (3,), "angle": (3, 5), "up": (3, 2, 3), "place": (3, 2), "time": (3,),
    }  # fmt: skip
    assert bool(whole.up.isnan().all())
    assert whole.time.tolist() == [math.inf] * 3
    assert not whole.angle.any()


def test_a_missing_size_is_named() -> None:
    with pytest.raises(KeyError, match="feet"):
        allocate(Whole, 3, "cpu", joints=5)


def test_the_struct_has_the_same_fields() -> None:
    struct: Any = WholeArrays
    assert list(struct.vars) == [f.name for f in fields(Whole)]
    types = {name: (variable.type.dtype, variable.type.ndim) for name, variable in list(struct.vars.items())[1:]}
    assert types == {"angle": (wp.float32, 2), "up": (wp.vec3, 2), "place": (wp.vec2, 1), "time": (wp.float32, 1)}
    assert list(struct.vars["part"].type.vars) == ["count", "on"]


def test_events_forecasts_and_games_begin_empty() -> None:
    events, forecast = allocate(BallEvents, 2, "cpu"), allocate(Forecast, 2, "cpu")
    game = allocate(GameState, 2, "cpu")
    for name, value in named_tensors(events).items():
        assert torch.equal(value, torch.full_like(value, math.inf if name.endswith("_time") else 0)), name
    for name, value in named_tensors(forecast).items():
        assert bool((~value if value.dtype == torch.bool else value.isnan()).all()), name
    assert game.referee.outcome.tolist() == [Outcome.BAD_SERVE] * 2
    assert bool(game.clock.fresh.all())
    for declared, struct in ((BallEvents, EventArrays), (GameState, GameArrays)):
        assert list(struct.vars) == [f.name for f in fields(declared)]  # type: ignore[attr-defined]
