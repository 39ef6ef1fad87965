"""What the robot remembers of its rubber: the share of the slip that a contact takes, against hits made up exactly."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.onboard.rubber import RubberMemory
from pace.task.observations import check_policy
from tests.helpers.envs import make_env
from tests.helpers.estimates import estimated
from tests.helpers.fakes import config
from tests.helpers.hits import DT, Rally

PRIOR = 0.7
NUMBERS = config("observation=rubber").observation.rubber_memory
BALL, PADDLE = torch.tensor([-4.0, 0.3, -0.5]), torch.tensor([1.5, -0.2, 0.4])  # m/s before the hit
NORMAL = torch.nn.functional.normalize(torch.tensor([0.9, 0.2, 0.3]), dim=0)


def returned(restitution: float, share: float, topspin: float) -> Tensor:
    """Velocity, m/s, after a contact that takes this share of the slip of a ball with this topspin, rad/s."""
    relative = BALL - PADDLE
    flight = torch.tensor([BALL[0], BALL[1], 0.0]) / BALL[:2].norm()
    spin = topspin * torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), flight)
    slip = relative + torch.linalg.cross(spin, -0.02 * NORMAL)  # the normal points at the ball
    slip = slip - (slip @ NORMAL) * NORMAL
    return BALL - (1.0 + restitution) * (relative @ NORMAL) * NORMAL - share * slip


class Hits(Rally):
    """Hits of a paddle whose normal points this way (1) or the other (-1)."""

    def __init__(self, side: float = 1.0, **changes: float) -> None:
        assert NUMBERS is not None
        self.numbers = replace(NUMBERS, **changes)
        super().__init__(RubberMemory(self.numbers, DT, 0), BALL, side * NORMAL)

    def hit(self, restitution: float, share: float, topspin: float) -> None:
        self.play(returned(restitution, share, topspin), PADDLE)
        self.next_ball()

    def seen(self, column: int) -> float:
        return float(self.memory["last_rubber"][0, column])


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("share", [0.1, 0.4, 0.73])
def test_one_hit_moves_both_priors_by_their_weights(share: float, side: float) -> None:
    rally = Hits(side)
    assert rally.memory["last_rubber"].abs().max() == 0.0
    rally.hit(0.6, share, rally.numbers.bounce_spin)
    weight = 1.0 / (rally.numbers.prior_hits + 1.0)
    assert rally.seen(3) == pytest.approx(weight * (0.6 - rally.numbers.prior), abs=1e-3)
    assert rally.seen(5) == pytest.approx(weight * (share - PRIOR), abs=2e-3)
    assert rally.seen(4) == rally.seen(6) == pytest.approx(1.0 / rally.numbers.hits)


def test_spin_that_is_not_seen_leaves_the_mean() -> None:
    rally = Hits()
    single = []
    for spin in 10 * (-40.0, 40.0):
        rally.hit(0.76, 0.6, rally.numbers.bounce_spin + spin)
        single.append(rally.seen(5) + PRIOR)
    assert abs(single[0] - 0.6) > 0.05  # one hit is off
    assert single[-1] == pytest.approx(0.6, abs=0.03)


def test_a_hit_without_slip_tells_no_share() -> None:
    rally = Hits(slip=50.0)
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
