"""What the modules compute from recorded readings is what commit 43400ac computed; see data/README.md.

That commit was told of each launch. Here the track finds it, at the same step or at most two later; in between, the
signals of that robot are not compared.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from pace.config.task import TaskConfig
from pace.onboard.actor import Readings
from pace.onboard.kinematics import PaddleChain
from pace.rl.policies import load_policy
from pace.sim.robot import build_model
from pace.sim.sensing import STAMPS
from pace.task.signals import ActorSignals
from tests.helpers.fakes import config
from tests.helpers.robot import SPEC
from tests.helpers.saved import remembering_policy

DATA = Path(__file__).parent / "data"
LATEST = 2  # control steps from a launch until the track has found it
TOLERANCE = 1e-5  # m, rad, s, 1; and of the value itself


def task_of(name: str) -> TaskConfig:
    if name == "paper":
        return config("observation=paper", "predictor=paper", "reward=paper")
    return remembering_policy().config if name == "memory" else load_policy("pretrained/pace").config


class Recording:
    """The events of a recording, one after another: control steps and resets."""

    def __init__(self, name: str) -> None:
        with np.load(DATA / f"{name}.npz") as file:
            self.values = {key: torch.from_numpy(file[key]) for key in file.files}
        self.event = 0
        names = [name for name in (*Readings._fields, "base_shift_noise") if name not in STAMPS]
        self.sensing = SimpleNamespace(**{name: self.now(f"reading.{name}").clone() for name in names})
        worlds = len(self.now("mask"))  # that commit had a frame in each step, of no known age
        self.sensing.base_age = self.sensing.ball_age = torch.zeros(worlds)
        self.sensing.base_new = self.sensing.ball_new = torch.ones(worlds, dtype=torch.bool)
        self.action = self.now("reading.action").clone()

    def __len__(self) -> int:
        return len(self.values["reset"])

    def now(self, key: str) -> Tensor:
        return self.values[key][self.event]

    def predict(self, positions: Tensor) -> Tensor:
        """The recorded predictions of the worlds that are asked for."""
        output = self.now("signal.prediction")
        return output[self.now("mask")] if self.now("reset") else output

    def go_to(self, event: int) -> None:
        self.event = event
        self.action.copy_(self.now("reading.action"))
        for name, value in vars(self.sensing).items():
            if name not in STAMPS:
                value.copy_(self.now(f"reading.{name}"))

    def expected(self, name: str) -> Tensor:
        """A signal by its name in :meth:`pace.onboard.actor.Signals.computed`."""
        owner, _, part = name.partition(".")
        return self.now(f"estimate.{owner}" if part == "state" else f"signal.{part}")


@pytest.mark.parametrize("name", ["memory", "default", "paper"])
def test_every_signal_is_as_recorded(name: str) -> None:
    task, recording = task_of(name), Recording(name)
    chain = PaddleChain(build_model(task.robot, task.engine, task.ball.table), SPEC.paddle)
    actor = ActorSignals(task, recording.sensing, recording.action, chain, recording.predict)  # type: ignore[arg-type]
    resets, launches, waiting = 0, 0, torch.zeros(len(recording.now("mask")))
    for event in range(len(recording)):
        recording.go_to(event)
        mask, positions = recording.now("mask"), actor.track.positions
        if recording.now("reset"):
            actor.begin(mask)
            resets += 1
            waiting[mask] = 0
        else:
            actor.step()
            launches += int(mask.sum())
            begun = (positions == positions[:, -3:].repeat(1, actor.onboard.track.frames)).all(1)
            waiting = torch.where(begun, 0, torch.where(mask | (waiting > 0), waiting + 1, 0))
            assert bool((waiting <= LATEST).all())
        for signal, value in actor.computed().items():
            if signal == "track.age":
                continue
            now, expected = value[waiting == 0], recording.expected(signal)[waiting == 0]
            torch.testing.assert_close(now, expected, atol=TOLERANCE, rtol=TOLERANCE, msg=f"{signal}, event {event}")
    assert resets > 1
    assert launches >= 3
    states = {key.removeprefix("estimate.") for key in recording.values if key.startswith("estimate.")}
    assert states == set(actor.estimates)
    if name == "memory":
        returns = recording.values["estimate.memory"][:, :, -1]
        assert bool((returns > 0.0).any(dim=0).all())  # every robot saw one of its returns
