"""The ball's track: what it holds, and what the robot can know of the ball from it."""

from __future__ import annotations

import pytest
import torch
import warp as wp

from pace.arrays.launch import Launch
from pace.config.base import ConfigError
from pace.onboard.ball_track import BallTrack
from pace.task.game import rules_of
from pace.task.rules import Rules, nothing_to_hit
from tests.helpers.fakes import config

YES = torch.ones(1, dtype=torch.bool)
LATE = torch.full((1,), 0.008)  # s


class Followed:
    """One ball and its track, so far."""

    def __init__(self, *sensed: float) -> None:
        self.step = BallTrack(config())
        self.track = self.step.begin(torch.tensor([sensed]), LATE)

    def see(self, *sensed: float) -> None:
        self.track = self.step(self.track, torch.tensor([sensed]), LATE, YES)

    def miss(self, times: int = 1) -> None:
        """Control steps without a frame: the last position again."""
        for _ in range(times):
            self.track = self.step(self.track, torch.full((1, 3), torch.nan), self.track.age + 0.02, ~YES)

    @property
    def new(self) -> bool:
        """The track began with what was sensed last."""
        return self.track.positions[0].tolist() == self.track.positions[0, -3:].tolist() * 5


def test_it_is_oldest_first_and_restarts_with_a_ball_that_jumps() -> None:
    ball = Followed(1.3, 0.0, 1.0)
    assert ball.track.positions[0, 0::3].tolist() == pytest.approx([1.3] * 5)
    for x in (1.2, 1.1, 1.0):
        ball.see(x, 0.0, 1.0)
    assert ball.track.positions[0, 0::3].tolist() == pytest.approx([1.3, 1.3, 1.2, 1.1, 1.0])
    ball.see(1.49, 0.0, 1.0)  # 24.5 m/s
    assert ball.track.positions[0, 0::3].tolist() == pytest.approx([1.3, 1.2, 1.1, 1.0, 1.49])
    ball.see(1.99, 0.1, 1.0)  # 25.5 m/s
    assert ball.track.positions[0, 0::3].tolist() == pytest.approx([1.99] * 5)


def test_a_serve_after_a_return_that_ended_where_it_starts_is_found_by_its_reversal() -> None:
    """The return ends within half a metre of the launch; the noise is twice the paper's, +-14 mm."""
    generator = torch.Generator().manual_seed(5)
    for end in torch.linspace(0.9, 1.8, 19).tolist():
        ball = Followed(-1.5, 0.0, 1.0)
        path = [-1.4 + (end + 1.4) * step / 30 for step in range(31)]  # 4 to 5.3 m/s
        launch = [1.35 - 0.1 * (step + 0.5) for step in range(5)]  # 5 m/s, sensed half a step late
        found = []
        for step, x in enumerate(path + launch):
            ball.see(x + 0.014 * float(2.0 * torch.rand((), generator=generator) - 1.0), 0.0, 1.0)
            found += [step - len(path)] if ball.new else []
        assert len(found) == 1
        assert 0 <= found[0] <= 2
        assert bool(ball.track.something_to_hit)


def test_a_ball_without_a_frame_falls_freely_for_a_tenth_of_a_second() -> None:
    def at(step: int) -> tuple[float, float, float]:
        return 1.3 - 0.1 * step, 0.02 * step, 1.0 + 2.0 * 0.02 * step - 0.5 * 9.81 * (0.02 * step) ** 2

    ball = Followed(*at(0))
    for step in range(1, 4):
        ball.see(*at(step))
    ball.miss(4)
    assert ball.track.positions[0].tolist() == pytest.approx([value for s in range(3, 8) for value in at(s)], abs=1e-5)
    ball.see(*at(8))
    assert not ball.new
    ball.miss(20)  # ages of 0.028 to 0.088 s: four steps, then it stays
    assert ball.track.positions[0].tolist() == pytest.approx([*at(12)] * 5, abs=1e-5)


def test_after_lost_frames_a_ball_may_have_flown_farther() -> None:
    """Two metres within five steps are 20 m/s. A ball that nobody saw for longer is a new one."""
    for gap, distance, new in ((0.1, 2.0, False), (0.1, 2.6, True), (0.14, 0.0, True)):
        ball = Followed(1.3, 0.0, 1.0)
        ball.see(1.2, 0.0, 1.0)
        ball.track = ball.track._replace(age=LATE + gap - 0.02)
        ball.see(1.2 - distance, 0.0, 1.0)
        assert ball.new is new


def test_noise_begins_no_track_of_a_ball_that_rests_or_flies() -> None:
    """Twice the paper's noise, +-14 mm on each axis; balls that lie, roll and fly away, turned or not."""
    torch.manual_seed(6)
    count, step = 4000, BallTrack(config())
    speed = torch.empty(count).uniform_(-0.1, 8.0)  # m/s along x; the slowest roll towards the robot
    start, turned = torch.tensor([0.5, 0.2, 0.8]).repeat(count, 1), torch.arange(count) % 2 == 0
    track = step.begin(start, torch.zeros(count))._replace(turned=turned)
    for moment in range(1, 50):
        start[:, 0] += speed * 0.02
        sensed = start + 0.014 * (2.0 * torch.rand(count, 3) - 1.0)
        assert not bool(step.new_ball(track, sensed, torch.zeros(count)).any()), moment
        track = step(track, sensed, torch.zeros(count), turned | ~turned)


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ([(1.0, 1.0), (0.9, 1.0), (0.8, 1.0)], True),
        ([(-1.8, 1.0), (-1.85, 1.0), (-1.91, 1.0)], False),  # past the robot
        ([(-1.0, 0.75), (-1.1, 0.72), (-1.2, 0.69)], False),  # too low
        ([(-1.5, 1.0), (-1.55, 0.99), (-1.6, 0.97)], False),  # behind the table and falling
        ([(-1.5, 1.0), (-1.55, 1.01), (-1.6, 1.02)], True),
        ([(-1.5, 1.0), (-1.4, 1.0), (-1.3, 1.0)], False),  # goes away
    ],
)
def test_something_to_hit_as_far_as_the_robot_can_know(path: list[tuple[float, float]], expected: bool) -> None:
    ball = Followed(path[0][0], 0.0, path[0][1])
    for x, z in path[1:]:
        ball.see(x, 0.0, z)
    assert bool(ball.track.something_to_hit) is expected


def test_noise_turns_no_ball_that_is_seen_late() -> None:
    """Motion capture that is more than a control step late sees a new ball where it was launched twice."""
    ball = Followed(1.350, 0.0, 1.0)
    assert bool(ball.track.something_to_hit)
    for x in (1.378, 1.25, 1.12):  # twice the paper's noise: +-14 mm
        ball.see(x, 0.0, 1.0)
        assert bool(ball.track.something_to_hit)
    for x in (-1.40, -1.43, -1.365):  # hit between the second and the third: 3.5 cm away again
        ball.see(x, 0.0, 1.0)
    assert bool(ball.track.turned)


def test_a_ball_that_turned_away_stays_gone_until_the_next_one() -> None:
    ball = Followed(-1.5, 0.0, 1.0)
    for x in (-1.4, -1.3, -1.35, -1.4, -1.45):  # comes back from the net
        ball.see(x, 0.0, 1.0)
    assert bool(ball.track.turned)
    assert not bool(ball.track.something_to_hit)
    ball.see(1.35, 0.0, 1.0)
    assert not bool(ball.track.turned)
    assert bool(ball.track.something_to_hit)


@wp.kernel
def _referees_rule(position: wp.array[wp.vec3], velocity: wp.array[wp.vec3], rules: Rules, found: wp.array[wp.bool]):
    world = wp.tid()
    found[world] = nothing_to_hit(position[world], velocity[world], rules)


def test_the_rule_is_that_of_the_referee() -> None:
    torch.manual_seed(3)
    count, found = 2000, torch.zeros(2000, dtype=torch.bool)
    positions = torch.tensor([-1.6, 0.0, 0.8]) + 0.4 * torch.randn(count, 3)
    change = 0.1 * torch.randn(count, 3)
    step = BallTrack(config("sensing.moved=0.0"))
    track = torch.cat((positions - change, positions - 0.5 * change, positions), dim=1).repeat(1, 2)[:, 3:]
    seen = step._judge(track, torch.zeros(count, dtype=torch.bool), torch.zeros(count))
    moved = (track[:, -3:] - track[:, -9:-6]).contiguous()
    given = {"position": positions, "velocity": moved, "rules": rules_of(config()), "found": found}
    Launch(_referees_rule, count, torch.device("cpu"), **given)()
    assert torch.equal(seen.something_to_hit, ~found)
    assert 0.1 < float(found.float().mean()) < 0.9


def test_too_few_frames_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"predictor\.frames must be at least 3, got 2"):
        BallTrack(config("predictor.frames=2"))
