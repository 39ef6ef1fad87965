"""What the robot remembers of its returns: the estimate of the restitution against hits that are made up exactly."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.task import ReturnMemoryConfig
from pace.onboard.returns import ReturnMemory
from pace.sim.ball.aero import GRAVITY
from pace.task.observations import check_policy
from tests.helpers.envs import make_env
from tests.helpers.estimates import estimated
from tests.helpers.fakes import config
from tests.helpers.hits import DT, POINT, Rally

PRIOR, PRIOR_HITS = 0.65, 0.5
CONFIG = ReturnMemoryConfig(PRIOR, PRIOR_HITS, hits=4.0, reach=0.5, closing_speed=2.0, largest=1.2)
BALL, PADDLE = torch.tensor([-5.0, 0.3, -0.5]), torch.tensor([1.5, -0.2, 0.4])  # m/s before the hit
NORMAL = torch.nn.functional.normalize(torch.tensor([0.9, 0.2, 0.3]), dim=0)


class Hits(Rally):
    """Hits of a paddle without friction."""

    def __init__(self) -> None:
        super().__init__(ReturnMemory(CONFIG, DT, 0), BALL, NORMAL)

    def hit(self, restitution: float, paddle: Tensor = PADDLE, away: Tensor | None = None, last: int = 10) -> Tensor:
        """See :meth:`Rally.play`; returns the ball's velocity after the hit."""
        closing = torch.dot(BALL - paddle, NORMAL)
        after = BALL - (1.0 + restitution) * closing * NORMAL
        self.play(after, paddle, away, last)
        return after

    @property
    def estimate(self) -> float:
        return float(self.memory["last_return"][0, 3]) + PRIOR


@pytest.mark.parametrize("restitution", [0.38, 0.65, 0.87])
def test_one_hit_moves_the_prior_by_its_weight(restitution: float) -> None:
    rally = Hits()
    assert rally.memory["last_return"].abs().max() == 0.0
    after = rally.hit(restitution)
    assert rally.estimate == pytest.approx((PRIOR * PRIOR_HITS + restitution) / (PRIOR_HITS + 1.0), abs=1e-3)
    # seen in the middle of the two steps that begin one step after the hit
    expected = after - torch.tensor([0.0, 0.0, 2.0 * DT * GRAVITY])
    assert torch.allclose(rally.memory["last_return"][0, :3], expected, atol=2e-3)
    assert float(rally.memory["last_return"][0, 4]) == pytest.approx(1.0 / CONFIG.hits)


def test_many_hits_come_to_the_truth_and_old_ones_fade() -> None:
    rally = Hits()
    for restitution, rounds in ((0.45, 12), (0.8, 12)):
        for _ in range(rounds):
            rally.next_ball()
            rally.hit(restitution)
        assert rally.estimate == pytest.approx(restitution, abs=0.03)
    assert float(rally.memory["last_return"][0, 4]) == pytest.approx(1.0)


def test_what_is_no_hit_of_the_paddle_teaches_nothing() -> None:
    rally = Hits()
    rally.hit(0.8, away=POINT - torch.tensor([0.6, 0.0, 0.0]))  # turned by the net, say
    assert rally.memory["last_return"].abs().max() == 0.0
    rally.next_ball()
    moving_with_it = BALL + torch.tensor([1.0, 0.0, 0.0])
    rally.hit(0.8, paddle=moving_with_it)  # too slow to tell a restitution; where the ball went is seen
    assert float(rally.memory["last_return"][0, 3]) == 0.0
    assert rally.memory["last_return"][0, :3].abs().max() > 1.0


def test_a_new_ball_before_the_return_was_seen_leaves_the_memory_as_it_was() -> None:
    rally = Hits()
    rally.hit(0.8)
    before = rally.memory["last_return"].clone()
    for last in (6, 7):  # seen to turn, one step after that; in the next its velocity would have been seen
        rally.next_ball()
        rally.hit(0.4, last=last)
        for _ in range(3):
            rally.next_ball()
        assert torch.equal(rally.memory["last_return"], before)


def test_it_can_be_forgotten_world_by_world() -> None:
    rally = Hits()
    rally.hit(0.8)
    rally.memory.restart(torch.tensor([False]))
    assert rally.memory.state.abs().max() > 0.0
    rally.memory.restart(torch.tensor([True]))
    assert rally.memory.state.abs().max() == 0.0


def test_the_actor_remembers_over_serves_and_forgets_with_the_episode() -> None:
    env = make_env(2, "native", "cpu", overrides=["observation=memory", "engine.threads=1"])
    seen = estimated(env, "memory", "last_return")
    seen.fill_(0.25)
    columns = env.policy_layout["last_return"]
    for _ in range(5):
        env.advance(torch.zeros(2, 21))
    frame = env.policy_observation.view(2, 5, -1)[:, -1, columns]
    assert torch.equal(frame, torch.full((2, 5), 0.25))
    saved = env.state_dict()
    env.reset_worlds(torch.tensor([True, False]))
    assert env.policy_observation.view(2, 5, -1)[:, -1, columns].tolist() == [[0.0] * 5, [0.25] * 5]
    env.load_state_dict(saved)
    assert torch.equal(seen, torch.full((2, 5), 0.25))


def test_the_critic_sees_the_contact_that_the_ball_has() -> None:
    env = make_env(64, "native", "cpu", overrides=["observation=memory", "randomization=wide", "engine.threads=1"])
    seen = env.critic_observation[:, env.critic_layout["paddle_restitution"]].squeeze(1)
    assert torch.equal(seen, torch.as_tensor(env.worlds.ball.params.paddle_restitution))
    assert float(seen.std()) > 0.05


def test_it_needs_its_numbers_and_five_frames() -> None:
    task = config("observation=memory")
    with pytest.raises(ConfigError, match="observation=memory"):
        check_policy(replace(task, observation=replace(task.observation, return_memory=None)))
    task = config("observation=memory", "predictor.frames=4")
    with pytest.raises(ConfigError, match=r"predictor.frames of 5 or more, got 4"):
        check_policy(task)
    with pytest.raises(ConfigError, match=r"return_memory.prior must lie in"):
        config("observation=memory", "observation.return_memory.prior=nan")
    with pytest.raises(ConfigError, match=r"return_memory.reach must be positive"):
        config("observation=memory", "observation.return_memory.reach=0.0")
