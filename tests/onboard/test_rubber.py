"""What the robot remembers of its rubber: the share of the slip that a contact takes, against hits made up exactly."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.task import RubberMemoryConfig
from pace.onboard.rubber import RubberMemory
from pace.sim.ball.aero import GRAVITY
from pace.task.env import make_env
from pace.task.observations import check_policy
from tests.helpers.estimates import Running, estimated
from tests.helpers.fakes import config

DT, PRIOR = 0.02, 0.7
NUMBERS = config("observation=rubber").observation.rubber_memory
BALL, PADDLE = torch.tensor([-4.0, 0.3, -0.5]), torch.tensor([1.5, -0.2, 0.4])  # m/s before the hit
NORMAL = torch.nn.functional.normalize(torch.tensor([0.9, 0.2, 0.3]), dim=0)
POINT = torch.tensor([-1.6, -0.2, 1.0])  # m, where they meet


def returned(restitution: float, share: float, topspin: float) -> Tensor:
    """Velocity, m/s, after a contact that takes this share of the slip of a ball with this topspin, rad/s."""
    relative = BALL - PADDLE
    flight = torch.tensor([BALL[0], BALL[1], 0.0]) / BALL[:2].norm()
    spin = topspin * torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), flight)
    slip = relative + torch.linalg.cross(spin, -0.02 * NORMAL)  # the normal points at the ball
    slip = slip - (slip @ NORMAL) * NORMAL
    return BALL - (1.0 + restitution) * (relative @ NORMAL) * NORMAL - share * slip


class Rally:
    """One world's memory, fed with hits; the normal of its paddle points this way (1) or the other (-1)."""

    def __init__(self, side: float = 1.0) -> None:
        assert NUMBERS is not None
        self.numbers, self.side = NUMBERS, side
        self.track, self.turned = torch.zeros(1, 15), torch.zeros(1, dtype=torch.bool)
        self.paddle, self.normal = torch.zeros(1, 3), side * NORMAL.repeat(1, 1)
        signals = {"track": self.track, "turned": self.turned}
        pose = {"paddle_position": self.paddle, "paddle_normal": self.normal}
        self.reads = lambda: signals | pose
        self.memory = Running(RubberMemory(self.numbers, DT, 0), self.reads)

    def hit(self, restitution: float, share: float, topspin: float) -> None:
        after, gravity = returned(restitution, share, topspin), torch.tensor([0.0, 0.0, -GRAVITY])
        path = []
        for step in range(-5, 6):  # 0 is the hit
            time, velocity = step * DT, BALL if step <= 0 else after
            path.append(POINT + velocity * time + 0.5 * gravity * time**2)
        for newest in range(4, 11):
            self.track.copy_(torch.stack(path[newest - 4 : newest + 1]).view(1, 15))
            self.paddle.copy_(POINT + PADDLE * (newest - 5) * DT)
            self.turned.fill_(newest >= 6)
            self.memory.update()
        self.track.copy_(torch.tensor([1.35, 0.0, 1.03]).repeat(1, 5))
        self.turned.fill_(False)
        self.memory.update()

    def seen(self, column: int) -> float:
        return float(self.memory["last_rubber"][0, column])


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("share", [0.1, 0.4, 0.73])
def test_one_hit_moves_both_priors_by_their_weights(share: float, side: float) -> None:
    rally = Rally(side)
    assert rally.memory["last_rubber"].abs().max() == 0.0
    rally.hit(0.6, share, rally.numbers.bounce_spin)
    weight = 1.0 / (rally.numbers.prior_hits + 1.0)
    assert rally.seen(3) == pytest.approx(weight * (0.6 - rally.numbers.prior), abs=1e-3)
    assert rally.seen(5) == pytest.approx(weight * (share - PRIOR), abs=2e-3)
    assert rally.seen(4) == rally.seen(6) == pytest.approx(1.0 / rally.numbers.hits)


def test_spin_that_is_not_seen_leaves_the_mean() -> None:
    rally = Rally()
    single = []
    for spin in 10 * (-40.0, 40.0):
        rally.hit(0.76, 0.6, rally.numbers.bounce_spin + spin)
        single.append(rally.seen(5) + PRIOR)
    assert abs(single[0] - 0.6) > 0.05  # one hit is off
    assert single[-1] == pytest.approx(0.6, abs=0.03)


def test_a_hit_without_slip_tells_no_share() -> None:
    rally = Rally()
    without = RubberMemoryConfig(**vars(rally.numbers) | {"slip": 50.0})
    rally.memory = Running(RubberMemory(without, DT, 0), rally.reads)
    rally.hit(0.6, 0.4, 150.0)
    assert rally.seen(3) != 0.0
    assert (rally.seen(5), rally.seen(6)) == (0.0, 0.0)


def test_the_actor_sees_it_and_the_critic_the_truth() -> None:
    wide = ["observation=rubber", "randomization=wide", "engine.threads=1"]
    env = make_env(64, "native", "cpu", overrides=wide)
    estimated(env, "rubber", "last_rubber").fill_(0.25)
    env.advance(torch.zeros(64, 21))
    frame = env.policy_observation.view(64, 5, -1)[:, -1, env.policy_layout["last_rubber"]]
    assert torch.equal(frame, torch.full((64, 7), 0.25))
    seen = env.critic_observation[:, env.critic_layout["paddle_tangential_restitution"]].squeeze(1)
    assert torch.equal(seen, torch.as_tensor(env.worlds.ball.params.paddle_tangential_restitution))
    assert float(seen.std()) > 0.1


def test_its_numbers_are_checked() -> None:
    with pytest.raises(ConfigError, match="prior_grip"):
        config("observation=rubber", "observation.rubber_memory.prior_grip=1.5")
    task = config("observation=rubber", "observation.rubber_memory=null")
    with pytest.raises(ConfigError, match="rubber_memory"):
        check_policy(task)
