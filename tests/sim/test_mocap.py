"""Motion capture with frames of its own: each of its numbers, in each world."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.sim import MocapConfig
from pace.sim.sensing import Sensing
from tests.helpers.fakes import CPU, config, fake_robot

DT = 0.02  # s
WORLDS, STEPS = 200, 500
PERIOD = 1.0 / 150.0  # s


class Filmed:
    """A ball and a robot that move along x, and what was sensed of one of them in each step.

    Attributes, (STEPS, WORLDS): ``error`` (..., 3) m to the truth at capture, ``age`` s, ``new``, ``stamp`` s.
    """

    def __init__(
        self, speed: float = 1.0, delay: tuple[float, float] = (0.004, 0.004), part: str = "ball", **mocap: Any
    ) -> None:
        numbers = replace(MocapConfig(rate=150.0), **mocap)
        clean = replace(config("sensing=clean").sensing, mocap_delay=list(delay), mocap=numbers)
        self.sensing = Sensing(clean, WORLDS, CPU, DT, torch.zeros(21), torch.Generator().manual_seed(0))
        self.robot, self.speed, self.part = fake_robot(WORLDS), speed, part
        self.ball = torch.tensor([0.0, 0.1, 1.0]).repeat(WORLDS, 1)
        if part == "base":
            self.robot.base_position.copy_(self.ball)
        self.nobody = torch.zeros(WORLDS, dtype=torch.bool)
        self.sensing.reset(~self.nobody, self.robot, self.ball)
        self.step = 0

    def run(self, steps: int = STEPS) -> Filmed:
        rows: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        for _ in range(steps):
            self.step += 1
            self.ball[:, 0] = self.speed * self.step * DT
            if self.part == "base":
                self.robot.base_position.copy_(self.ball)
            self.sensing.update(self.robot, self.ball, self.nobody)
            position, age, new = (
                getattr(self.sensing, f"{self.part}_{signal}").clone() for signal in ("position", "age", "new")
            )
            stamp, truth = self.step * DT - age, self.ball.clone()
            truth[:, 0] = (self.speed * stamp).clamp(min=0.0)  # it rested until the first step
            rows.append((position - truth, age, new, stamp))
        self.error, self.age, self.new, self.stamp = (torch.stack(row) for row in zip(*rows, strict=True))
        return self

    def between(self) -> Tensor:
        """Times, s, between the captures of frames that followed one another, of all worlds."""
        later = self.stamp[5:]  # the first frame follows the one that the reset gave
        return (later - self.stamp[4:-1])[self.new[5:]]


@pytest.mark.parametrize("part", ["ball", "base"])
def test_frames_have_their_rate_and_are_held_in_between(part: str) -> None:
    filmed = Filmed(part=part, rate=30.0).run()
    assert filmed.new.sum(0).tolist() == pytest.approx([30.0 * STEPS * DT] * WORLDS, abs=1.1)
    torch.testing.assert_close(filmed.between(), torch.full_like(filmed.between(), 1.0 / 30.0), atol=1e-4, rtol=0.0)
    # each position is that of the time it was captured, also while it is held
    assert float(filmed.error.abs().max()) < 1e-4
    first = filmed.new.int().argmax(0)
    assert len(first.unique()) > 1  # the cameras of different worlds do not start together


@pytest.mark.parametrize("part", ["ball", "base"])
def test_three_frames_a_step_and_the_newest_that_arrived(part: str) -> None:
    filmed = Filmed(part=part, delay=(0.0, 0.030)).run(50)
    late = filmed.sensing.delay * DT
    waited = filmed.age[5:] - late
    assert bool(filmed.new[5:].all())
    assert float(waited.min()) > -1e-5
    assert float(waited.max()) < PERIOD + 1e-5
    assert float(waited.mean()) == pytest.approx(PERIOD / 2, abs=3e-4)


@pytest.mark.parametrize("part", ["ball", "base"])
def test_the_delay_of_frames_jitters_in_its_range(part: str) -> None:
    filmed = Filmed(part=part, rate=20.0, delay=(0.004, 0.004), jitter=[0.0, 0.026]).run()
    found = filmed.age[filmed.new]  # delay, jitter, and the wait for the control step
    assert 0.004 <= float(found.min()) < 0.0055
    assert 0.048 < float(found.max()) <= 0.004 + 0.026 + DT + 1e-5
    assert float(found.mean()) == pytest.approx(0.004 + 0.013 + DT / 2, abs=3e-4)
    assert float(found.std()) == pytest.approx(math.sqrt((0.026**2 + DT**2) / 12), rel=0.02)
    per_world = torch.stack([filmed.age[filmed.new[:, w], w].std() for w in range(WORLDS)])  # of 200 frames
    assert per_world.tolist() == pytest.approx([math.sqrt((0.026**2 + DT**2) / 12)] * WORLDS, rel=0.25)


@pytest.mark.parametrize("part", ["ball", "base"])
def test_white_noise(part: str) -> None:
    error = Filmed(part=part, white_noise=0.0019).run().error
    assert error.std(0).flatten().tolist() == pytest.approx([0.0019] * 3 * WORLDS, rel=0.15)
    assert float(error.std()) == pytest.approx(0.0019, rel=0.01)
    assert float((error[1:] * error[:-1]).mean()) / 0.0019**2 == pytest.approx(0.0, abs=0.01)
    assert float((error[..., 0] * error[..., 1]).mean()) / 0.0019**2 == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("part", ["ball", "base"])
def test_slow_noise_has_its_deviation_and_its_time(part: str) -> None:
    """Source of the numbers: 5.2 mm, rho 0.946 at 300 Hz."""
    error = Filmed(part=part, slow_noise=0.0052, slow_noise_time=0.06).run().error
    assert float(error.std()) == pytest.approx(0.0052, rel=0.02)
    per_world = error.std(0).mean(1)
    assert float(per_world.min()) > 0.004
    for lag in (1, 3, 10):
        same = float((error[lag:] * error[:-lag]).mean() / error.square().mean())
        assert same == pytest.approx(0.946 ** (300.0 * DT * lag), abs=0.02)
    assert error[0].std() == pytest.approx(0.0052, rel=0.1)  # from the beginning


@pytest.mark.parametrize("part", ["ball", "base"])
def test_frames_are_lost_singly(part: str) -> None:
    filmed = Filmed(part=part, rate=20.0, lost=0.3).run()
    arrived = filmed.new.float().sum(0) / (20.0 * STEPS * DT)
    assert float(arrived.mean()) == pytest.approx(0.7, abs=0.01)
    assert float(arrived.std()) == pytest.approx(math.sqrt(0.3 * 0.7 / 200), rel=0.2)  # each frame by itself
    missing = (filmed.between() * 20.0).round() - 1.0
    assert float((missing == 0).float().mean()) == pytest.approx(0.7, abs=0.01)
    assert float((missing == 1).float().mean()) == pytest.approx(0.3 * 0.7, abs=0.01)


@pytest.mark.parametrize("part", ["ball", "base"])
def test_frames_are_lost_in_runs(part: str) -> None:
    filmed = Filmed(part=part, gap_rate=0.5, gap=[0.05, 0.1]).run()
    between = filmed.between()
    runs = between[between > 0.03]
    rate = 0.5 / (1.0 + 0.5 * 0.075)  # 1/s, of runs: a Poisson process between them
    assert len(runs) / (WORLDS * STEPS * DT) == pytest.approx(rate, rel=0.06)
    late = ((filmed.stamp[5:] - filmed.stamp[4:-1] > 0.03) & filmed.new[5:]).float().sum(0)  # runs of each world
    mean = rate * (STEPS - 5) * DT
    assert float(late.mean()) == pytest.approx(mean, rel=0.06)
    assert float(late.var()) == pytest.approx(mean, rel=0.3)
    # the frame that began the run, those within it, and up to two that a newer one replaced within the control step
    assert 0.05 < float(runs.min()) < 0.06
    single = runs < 0.1 + 4 * PERIOD  # else the next run began at once
    assert float(single.float().mean()) > 0.97
    assert float(runs[single].max()) > 0.11
    assert float(runs[single].mean()) == pytest.approx(0.075 + 2.5 * PERIOD, abs=0.002)


@pytest.mark.parametrize("part", ["ball", "base"])
def test_one_frame_a_control_step_may_be_lost(part: str) -> None:
    filmed = Filmed(part=part, rate=0.0, lost=0.2).run()
    assert float(filmed.error.abs().max()) < 1e-4  # what is held has its own age
    came = filmed.new.float().mean(0)
    assert float(came.mean()) == pytest.approx(0.8, abs=0.005)
    assert float(came.std()) == pytest.approx(math.sqrt(0.2 * 0.8 / STEPS), rel=0.2)  # of the worlds
    waited = ((filmed.age - 0.004) / DT).round()
    assert float((filmed.age - 0.004 - waited * DT).abs().max()) < 1e-4
    assert float((waited[5:] == 2).float().mean()) == pytest.approx(0.8 * 0.2**2, abs=0.004)
    assert bool(((waited == 0) == filmed.new).all())


@pytest.mark.parametrize("part", ["ball", "base"])
def test_the_delay_of_one_frame_a_control_step_jitters(part: str) -> None:
    filmed = Filmed(part=part, rate=0.0, jitter=[0.0, 0.016]).run()
    assert float(filmed.error.abs().max()) < 1e-4
    assert bool(filmed.new.all())
    assert 0.004 <= float(filmed.age.min()) < 0.0045
    assert 0.0195 < float(filmed.age.max()) <= 0.02 + 1e-6
    assert filmed.age.mean(0).tolist() == pytest.approx([0.012] * WORLDS, abs=0.001)
    assert filmed.age.std(0).tolist() == pytest.approx([0.016 / math.sqrt(12)] * WORLDS, rel=0.15)
    # by more than a step: a frame that is older than the one before comes to nothing
    filmed = Filmed(part=part, rate=0.0, jitter=[0.0, 0.026]).run()
    assert float((filmed.stamp[1:] - filmed.stamp[:-1]).min()) > -1e-6
    assert float(filmed.new.float().mean()) == pytest.approx(1.0 - (0.026 - DT) ** 2 / (2 * 0.026**2), abs=0.004)


@pytest.mark.parametrize("part", ["ball", "base"])
def test_one_frame_a_control_step_has_white_and_slow_noise(part: str) -> None:
    error = Filmed(part=part, rate=0.0, slow_noise=0.0052, slow_noise_time=0.06).run().error
    assert float(error.std()) == pytest.approx(0.0052, rel=0.02)
    assert float(error.std(0).mean(1).min()) > 0.004
    for lag in (1, 3, 10):
        same = float((error[lag:] * error[:-lag]).mean() / error.square().mean())
        assert same == pytest.approx(math.exp(-DT * lag / 0.06), abs=0.02)
    assert error[0].std() == pytest.approx(0.0052, rel=0.1)
    white = Filmed(part=part, rate=0.0, white_noise=0.0019).run().error
    assert float(white.std()) == pytest.approx(0.0019, rel=0.01)
    assert float((white[1:] * white[:-1]).mean()) / 0.0019**2 == pytest.approx(0.0, abs=0.01)


def test_the_ball_is_hidden_around_the_strike() -> None:
    """At 6 m/s past a paddle that stands still, 0.18 m are 30 ms on either side."""
    filmed = Filmed(speed=6.0, occlusion=0.18)
    filmed.robot.paddle_position.copy_(torch.tensor([3.0, 0.1, 1.0]))
    filmed.run(50)
    hidden = filmed.between()
    longest = torch.stack([(filmed.stamp[1:, w] - filmed.stamp[:-1, w]).max() for w in range(WORLDS)])
    assert float(longest.min()) > 0.06 - 1e-4
    assert float(longest.max()) < 0.06 + 4 * PERIOD
    assert float((hidden > 0.03).float().sum()) == WORLDS
    seen = filmed.speed * filmed.stamp[filmed.new]
    assert float((seen - 3.0).abs().min()) > 0.18 - 1e-3


def test_out_of_view_no_frame_holds_the_ball_but_the_base_is_seen() -> None:
    filmed = Filmed()
    filmed.run(5)
    before = filmed.sensing.ball_position.clone()
    hidden = torch.arange(WORLDS) % 2 == 0
    for step in range(1, 4):
        filmed.ball[:, 0] += 0.1
        filmed.robot.base_position[:, 0] = -1.8 + 0.1 * step
        filmed.sensing.update(filmed.robot, filmed.ball, filmed.nobody, ~hidden)
        assert bool((filmed.sensing.ball_new == ~hidden).all()) or step == 1  # one may have been on its way
    assert float((filmed.sensing.ball_position - before)[hidden, 0].abs().max()) < 0.02
    assert float((filmed.sensing.ball_position - before)[~hidden, 0].min()) > 0.2
    assert float(filmed.sensing.base_position[:, 0].min()) > -1.6
    assert float(filmed.sensing.ball_age[hidden].min()) > 3 * DT - 1e-4
    assert bool(filmed.sensing.base_new.all())
    assert float(filmed.sensing.base_age.max()) < 0.004 + PERIOD + 1e-5


def test_no_frame_lies_between_two_balls() -> None:
    filmed = Filmed(speed=0.0, delay=(0.0, 0.030)).run(5)
    filmed.ball[:] = torch.tensor([1.35, 0.1, 1.0])
    arrived = torch.zeros(WORLDS)
    for step in range(5):
        filmed.sensing.update(filmed.robot, filmed.ball, ~filmed.nobody if step == 0 else filmed.nobody)
        x = filmed.sensing.ball_position[:, 0]
        launched = (x - 1.35).abs() < 1e-6
        assert bool(((x == 0.0) | launched).all())
        age = step * DT - filmed.sensing.delay * DT  # of a frame that has just arrived, since the launch
        assert bool((x[age < -1e-5] == 0.0).all())
        arrived += launched
    assert float(arrived.min()) >= 2.0


def test_worlds_are_independent() -> None:
    error = Filmed(white_noise=0.0019, slow_noise=0.0052, lost=0.1).run().error[..., 0]
    worlds = torch.corrcoef(error.T) - torch.eye(WORLDS)
    assert float(worlds.mean()) == pytest.approx(0.0, abs=0.005)
    assert float(worlds.abs().max()) < 0.6  # of 20,000 pairs with about 83 independent times each


@pytest.mark.parametrize("given", ["sensing=mocap", "sensing.mocap.lost=0.2"])
def test_its_state_resumes_exactly(given: str) -> None:
    numbers = replace(config(given).sensing.mocap, slow_noise=0.005)
    one, other = (Filmed(**vars(numbers)) for _ in range(2))
    one.run(20)
    other.sensing.load_state_dict(one.sensing.state_dict())
    other.sensing._generator.set_state(one.sensing._generator.get_state())
    other.step = one.step
    one.run(30)
    other.run(30)
    assert torch.equal(one.sensing.base_age, other.sensing.base_age)
    for name in ("error", "age", "new"):
        assert torch.equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rate": -1.0}, "rate must be finite and not negative"),
        ({"white_noise": math.inf}, "white_noise must be finite"),
        ({"lost": 1.5}, "lost must lie within 0 and 1"),
        ({"slow_noise_time": 0.0}, "slow_noise_time must be positive"),
        ({"jitter": [0.02, 0.01]}, "jitter: low 0.02 is above high"),
        ({"gap": [0.0, math.inf]}, "gap must be finite"),
        ({"occlusion": 0.2}, "occlusion needs sensing.mocap.rate"),
    ],
)
def test_bad_numbers_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        MocapConfig(**change)
