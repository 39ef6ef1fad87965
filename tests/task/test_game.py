"""The referee's cases one by one, targets, serves and their clock."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from pace.config.base import ConfigError
from pace.config.task import ServeConfig
from pace.sim.ball.ball import BallParams, BallSim
from pace.task.game import Game, Outcome
from pace.task.resets import PoseSampler, ServeSampler, world_spin
from pace.task.state import TaskState
from tests.helpers.fakes import CPU, config, fake_ball, fake_game, set_events
from tests.helpers.robot import JOINT_NAMES

YES = torch.ones(1, dtype=torch.bool)
BOUNCE: dict[str, Any] = {"own_bounce": 0.010}
HIT: dict[str, Any] = {"paddle_hit": 0.005}


class Serve:
    """One serve in one world, told as the events of its control steps."""

    def __init__(self, playable: bool = True, *overrides: str) -> None:
        self.game, worlds = fake_game(1, config(*(overrides or ("serve=mixed",))))
        self.table_force = worlds.engine.table_force
        self.ball, self.robot = worlds.ball, worlds.robot
        self.referee, self.ends, self.closeness = self.game.referee, self.game.ends, self.game.closeness
        if not playable:
            self.ball.forecast_result.bounce_time.fill_(torch.nan)
            self.game.start_serve(YES)
        self.successes = 0

    def step(self, x: float = -1.0, distance: float = 1.0, **times: Any) -> Serve:
        self.ball.position[:, 0] = x
        self.ball.nearest_paddle_distance.fill_(distance + 0.02)
        set_events(self.ball.events, **times)
        self.game.judge()
        self.game.close()
        self.successes += int(self.referee.success_now)
        return self

    def end(self, fallen: bool = False) -> Serve:
        """Time is up, or the robot falls."""
        if fallen:
            self.robot.base_position[:, 2] = 0.3
        else:
            self.game.clock.time.fill_(1.8)
        return self.step()

    @property
    def outcome(self) -> Outcome:
        return Outcome(int(self.referee.outcome))

    @property
    def hit(self) -> bool:
        return bool(self.referee.hit)


def test_a_valid_return_is_a_hit_and_one_success() -> None:
    serve = Serve().step(**BOUNCE).step(**HIT)
    assert serve.hit
    assert bool(serve.referee.hit_now)
    assert serve.outcome == Outcome.OPEN
    assert float(serve.referee.touch_time) == pytest.approx(0.025)
    serve.step(x=1.0, opponent_bounce=0.01)
    assert serve.outcome == Outcome.SUCCESS
    serve.step(x=1.3, opponent_bounce=0.01).step(x=2.0, floor=0.01).end()
    assert serve.outcome == Outcome.SUCCESS
    assert serve.successes == 1


def test_the_hit_is_seen_in_one_step_only() -> None:
    serve = Serve().step(**BOUNCE).step(**HIT)
    serve.step()
    assert serve.hit
    assert not bool(serve.referee.hit_now)


@pytest.mark.parametrize(
    ("steps", "outcome", "hit"),
    [
        pytest.param([BOUNCE, {"floor": 0.01}], Outcome.MISS, False, id="passed to the floor"),
        pytest.param([BOUNCE, {"own_bounce": 0.01}, HIT], Outcome.MISS, False, id="bounced twice, then touched"),
        pytest.param([BOUNCE, {"floor": 0.001, "paddle_hit": 0.01}], Outcome.MISS, False, id="floor before paddle"),
        pytest.param([BOUNCE, {"edge": 0.001, "paddle_hit": 0.01}], Outcome.MISS, False, id="edge before paddle"),
        pytest.param([BOUNCE, HIT, {"floor": 0.01, "x": 1.9}], Outcome.OUT, True, id="long"),
        pytest.param([BOUNCE, HIT, {"floor": 0.01, "x": -0.9}], Outcome.OUT, True, id="wide"),
        pytest.param([BOUNCE, HIT, {"own_bounce": 0.01}], Outcome.OWN_SIDE, True, id="own side"),
        pytest.param(
            [BOUNCE, HIT, {"net": 0.01}, {"own_bounce": 0.01, "x": -0.1}], Outcome.NET, True, id="net, falls back"
        ),
        pytest.param(
            [BOUNCE, HIT, {"net": 0.01}, {"floor": 0.01, "x": -0.1}], Outcome.NET, True, id="net, beside the table"
        ),
        pytest.param([BOUNCE, HIT, {"net": 0.01}, {"floor": 0.01, "x": 0.3}], Outcome.OUT, True, id="net cord, out"),
        pytest.param(
            [BOUNCE, HIT, {"net": 0.01}, {"opponent_bounce": 0.01, "x": 0.2}], Outcome.SUCCESS, True, id="net cord, in"
        ),
        pytest.param([BOUNCE, HIT, {"paddle_hit": 0.01}], Outcome.DOUBLE_HIT, True, id="double hit"),
        pytest.param([BOUNCE, {"paddle_hit": (0.005, 0.015)}], Outcome.DOUBLE_HIT, True, id="double hit in one step"),
        pytest.param([HIT, BOUNCE], Outcome.VOLLEY, False, id="volley"),
        pytest.param([HIT, {"opponent_bounce": 0.01}], Outcome.VOLLEY, False, id="volley is no return"),
        pytest.param(
            [BOUNCE, HIT, {"opponent_bounce": 0.004, "paddle_hit": 0.01}], Outcome.SUCCESS, True, id="decided before"
        ),
    ],
)
def test_outcomes(steps: list[dict[str, Any]], outcome: Outcome, hit: bool) -> None:
    serve = Serve()
    for step in steps:
        serve.step(**step)
    assert serve.outcome == outcome
    assert serve.hit is hit
    assert serve.end().outcome == outcome


@pytest.mark.parametrize(
    ("times", "outcome"),
    [
        ({"own_bounce": 0.002, "paddle_hit": 0.010}, Outcome.OPEN),  # half volley: bounce, then hit
        ({"own_bounce": 0.010, "paddle_hit": 0.002}, Outcome.VOLLEY),
        ({"own_bounce": (0.002, 0.015), "paddle_hit": 0.010}, Outcome.OWN_SIDE),  # bounce, hit, bounce
    ],
)
def test_order_within_one_control_step(times: dict[str, Any], outcome: Outcome) -> None:
    assert Serve().step(**times).outcome == outcome


def test_hit_and_landing_within_one_control_step() -> None:
    serve = Serve().step(**BOUNCE).step(x=0.2, paddle_hit=0.001, opponent_bounce=0.019)
    assert serve.outcome == Outcome.SUCCESS
    early = Serve().step(**BOUNCE).step(x=0.2, paddle_hit=0.019, opponent_bounce=0.001)
    assert early.outcome == Outcome.OPEN


def test_own_bounce_after_the_hit_in_the_step_of_the_hit() -> None:
    serve = Serve().step(**BOUNCE).step(paddle_hit=0.002, own_bounce=0.015)
    assert serve.outcome == Outcome.OWN_SIDE
    before = Serve().step(**BOUNCE).step(paddle_hit=0.015, own_bounce=0.002)
    assert before.outcome == Outcome.MISS


def test_net_before_the_hit_does_not_count_against_the_robot() -> None:
    serve = Serve().step(net=0.01).step(**BOUNCE).step(**HIT).step(own_bounce=0.01)
    assert serve.outcome == Outcome.OWN_SIDE


def test_rim_hits_are_marked() -> None:
    serve = Serve().step(**BOUNCE)
    set_events(serve.ball.events, **HIT)
    serve.ball.events.hit_rim.fill_(True)
    serve.game.judge()
    assert bool(serve.referee.rim)


BODY: dict[str, Any] = {"body": 0.01}


@pytest.mark.parametrize(
    ("steps", "outcome", "hit"),
    [
        pytest.param([BODY], Outcome.BODY, False, id="before the bounce: obstruction"),
        pytest.param([BOUNCE, BODY], Outcome.BODY, False, id="before the hit"),
        pytest.param([BOUNCE, BODY, HIT, {"opponent_bounce": 0.01}], Outcome.BODY, False, id="then returned"),
        pytest.param([BOUNCE, HIT, BODY], Outcome.BODY, True, id="after the hit"),
        pytest.param([BOUNCE, {"body": 0.004, "paddle_hit": 0.006}], Outcome.BODY, False, id="in the step of the hit"),
        pytest.param([BOUNCE, {"paddle_hit": 0.004, "body": 0.006}], Outcome.BODY, True, id="right after the hit"),
        pytest.param([{"own_bounce": 0.006, "body": 0.004}], Outcome.BODY, False, id="just before the bounce"),
        pytest.param(
            [BOUNCE, HIT, {"opponent_bounce": 0.01}, BODY], Outcome.SUCCESS, True, id="after the landing: decided"
        ),
        pytest.param(
            [BOUNCE, HIT, {"opponent_bounce": 0.004, "body": 0.01}], Outcome.SUCCESS, True, id="landed just before"
        ),
        pytest.param([BOUNCE, HIT, {"opponent_bounce": 0.01, "body": 0.004}], Outcome.BODY, True, id="just after"),
        pytest.param([BOUNCE, HIT, {"net": 0.002, "body": 0.004}], Outcome.BODY, True, id="off the net onto the body"),
        pytest.param([BOUNCE, {"floor": 0.004, "body": 0.01}], Outcome.MISS, False, id="floor before body"),
        pytest.param([BOUNCE, {"floor": 0.01, "body": 0.004}], Outcome.BODY, False, id="body before floor"),
        pytest.param(
            [BOUNCE, {"own_bounce": 0.004, "body": 0.01}], Outcome.MISS, False, id="second bounce before body"
        ),
        pytest.param(
            [BOUNCE, {"own_bounce": 0.01, "body": 0.004}], Outcome.BODY, False, id="body before second bounce"
        ),
        pytest.param([HIT, BODY], Outcome.VOLLEY, False, id="volley before"),
    ],
)
def test_a_touch_by_the_body_loses_the_point(steps: list[dict[str, Any]], outcome: Outcome, hit: bool) -> None:
    serve = Serve()
    for step in steps:
        serve.step(**step)
    assert serve.outcome == outcome
    assert serve.hit is hit
    assert serve.end().outcome == outcome


#: N, force on the robot in both physics steps; the table pushes back at 100 N mean over the step.
TOP, SIDE, NONE = (0.0, 0.0, 5.0), (-60.0, 0.0, 20.0), (0.0, 0.0, 0.0)
PUSH, LEAN = (-150.0, 0.0, 20.0), (0.0, 0.0, 150.0)


@pytest.mark.parametrize(
    ("robot", "hand", "step", "outcome"),
    [
        pytest.param((TOP, NONE), (TOP, NONE), {}, Outcome.FREE_HAND, id="free hand on the top"),
        pytest.param((TOP, TOP), (NONE, NONE), {}, Outcome.OPEN, id="the paddle on the top"),
        pytest.param((SIDE, SIDE), (SIDE, SIDE), {}, Outcome.OPEN, id="free hand at the table's side"),
        pytest.param(((0, 0, -9.0), NONE), ((0, 0, -9.0), NONE), {}, Outcome.OPEN, id="free hand under the top"),
        pytest.param(((-99.0, 0, 0), (-99.0, 0, 0)), (NONE, NONE), {}, Outcome.OPEN, id="a thigh leans on the edge"),
        pytest.param(
            ((-101.0, 0, 0), (-101.0, 0, 0)), (NONE, NONE), {}, Outcome.TABLE_TOUCH, id="a thigh pushes the edge"
        ),
        pytest.param(((0, 0, 190.0), NONE), (NONE, NONE), {}, Outcome.OPEN, id="a knock of the paddle"),
        pytest.param(((0, 0, 210.0), NONE), (NONE, NONE), {}, Outcome.TABLE_TOUCH, id="a hard blow of the paddle"),
        pytest.param(((-150.0, 0, 0), (150.0, 0, 0)), (NONE, NONE), {}, Outcome.OPEN, id="there and back"),
        pytest.param((PUSH, PUSH), (PUSH, PUSH), {}, Outcome.TABLE_TOUCH, id="free hand pushes the side"),
        pytest.param((LEAN, LEAN), (LEAN, LEAN), {}, Outcome.FREE_HAND, id="free hand leans on the top"),
        pytest.param((LEAN, LEAN), (NONE, TOP), {}, Outcome.FREE_HAND, id="hand before the push is over"),
        pytest.param(((0, 0, 210.0), TOP), (NONE, TOP), {}, Outcome.TABLE_TOUCH, id="push before hand"),
        pytest.param((NONE, TOP), (NONE, TOP), {"body": 0.011}, Outcome.FREE_HAND, id="hand before body"),
        pytest.param((NONE, TOP), (NONE, TOP), {"body": 0.009}, Outcome.BODY, id="body before hand"),
    ],
)
@pytest.mark.parametrize("hit", [False, True])
def test_the_table_must_not_be_touched_nor_pushed(
    robot: tuple[Any, ...], hand: tuple[Any, ...], step: dict[str, float], outcome: Outcome, hit: bool
) -> None:
    serve = Serve().step(**BOUNCE)
    if hit:
        serve.step(**HIT)
    serve.table_force[0, :, 0], serve.table_force[0, :, 1] = torch.tensor(robot), torch.tensor(hand)
    assert serve.step(**step).outcome == outcome
    assert serve.hit is hit


def test_a_touch_of_the_table_counts_by_its_time_among_the_others() -> None:
    for times, outcome in (
        ({"opponent_bounce": 0.009}, Outcome.SUCCESS),
        ({"opponent_bounce": 0.011}, Outcome.FREE_HAND),
    ):
        serve = Serve().step(**BOUNCE).step(**HIT)
        serve.table_force[0, 1] = torch.tensor(TOP)  # from 0.010 s on
        assert serve.step(x=1.0, **times).outcome == outcome
        serve.table_force[0, 0] = torch.tensor(TOP)
        assert serve.step().outcome == outcome


def test_a_robot_without_a_free_hand_can_only_push() -> None:
    game, worlds = fake_game(2)
    pushing = torch.zeros(2, 2, 1, 3)
    pushing[0], pushing[1] = torch.tensor([0.0, 0.0, 30.0]), torch.tensor([0.0, 0.0, 120.0])
    game = Game(config(), worlds.ball, worlds.robot.base_position, pushing)
    game.start_serve(torch.ones(2, dtype=torch.bool))
    game.judge()
    assert game.referee.outcome.tolist() == [Outcome.OPEN, Outcome.TABLE_TOUCH]


def test_what_is_touched_when_the_ball_is_not_in_play_is_no_fault() -> None:
    serve = Serve(playable=False).step(**BODY)
    assert serve.outcome == Outcome.BAD_SERVE
    serve = Serve().step(**BOUNCE).step(**HIT).step(x=1.0, opponent_bounce=0.01)
    serve.game.pause.waiting.fill_(True)
    serve.table_force.fill_(200.0)
    assert serve.step(**BODY).outcome == Outcome.SUCCESS


def test_no_contact_is_a_miss_at_the_end_of_the_serve() -> None:
    serve = Serve().step(**BOUNCE).step()
    assert serve.outcome == Outcome.OPEN
    assert serve.end().outcome == Outcome.MISS
    assert serve.ends.over
    assert serve.ends.next_serve


@pytest.mark.parametrize(
    ("own", "opponent", "x", "outcome"),
    [
        (False, True, 1.0, Outcome.SUCCESS),
        (True, False, -0.3, Outcome.OWN_SIDE),
        (False, False, 1.9, Outcome.OUT),
        (False, False, math.nan, Outcome.OUT),
    ],
)
def test_a_flight_cut_off_by_the_clock_is_decided_by_its_forecast(
    own: bool, opponent: bool, x: float, outcome: Outcome
) -> None:
    serve = Serve().step(**BOUNCE)
    forecast = serve.ball.forecast_result
    forecast.landing_own.fill_(own)
    forecast.landing_opponent.fill_(opponent)
    forecast.landing.fill_(x)
    serve.step(**HIT)
    assert serve.outcome == Outcome.OPEN
    assert serve.end().outcome == outcome
    assert serve.successes == int(outcome == Outcome.SUCCESS)


def test_a_fall_decides_an_open_serve_only() -> None:
    fallen = Serve().step(**BOUNCE).end(fallen=True)
    assert fallen.outcome == Outcome.FALL
    assert fallen.ends.lost
    assert not fallen.ends.next_serve
    decided = Serve().step(**BOUNCE).step(**HIT).step(opponent_bounce=0.01)
    assert decided.end(fallen=True).outcome == Outcome.SUCCESS


def test_a_serve_that_never_bounces_is_nobodys_fault() -> None:
    serve = Serve(playable=False).step(**HIT).step(floor=0.01).end()
    assert serve.outcome == Outcome.BAD_SERVE
    assert not serve.hit


def test_a_new_serve_starts_clean_and_only_where_asked() -> None:
    game, worlds = fake_game(2)
    for times in (BOUNCE, HIT):
        set_events(worlds.ball.events, **times)
        game.judge()
        game.close()
    game.start_serve(torch.tensor([True, False]))
    assert game.referee.hit.tolist() == [False, True]
    assert game.referee.own_bounces.tolist() == [0, 1]
    assert game.referee.touch_time.tolist() == [math.inf, pytest.approx(0.025)]
    assert game.clock.time.tolist() == [0.0, pytest.approx(0.04)]


def test_intercept_and_clamp_targets() -> None:
    game, worlds = fake_game()
    torch.testing.assert_close(game.target.point, worlds.ball.forecast_result.intercept)
    assert float(game.target.time) == pytest.approx(0.68)
    game, worlds = fake_game(1, config("reward=paper"))
    torch.testing.assert_close(game.target.point, torch.tensor([[-1.6, 0.1, 1.1]]))
    torch.testing.assert_close(game.target.apex, worlds.ball.forecast_result.apex)
    assert float(game.target.time) == pytest.approx(0.6)


def test_targets_have_no_nan() -> None:
    game, worlds = fake_game(2)
    forecast = worlds.ball.forecast_result
    forecast.bounce_time[0] = torch.nan
    forecast.apex[0] = torch.nan
    forecast.intercept[:] = torch.nan
    forecast.intercept_time[:] = torch.nan
    game.start_serve(torch.ones(2, dtype=torch.bool))
    target = game.target
    assert target.playable.tolist() == [False, True]
    torch.testing.assert_close(target.point[0], torch.tensor([-1.7, -0.3, 1.0]))  # to stand by
    torch.testing.assert_close(target.point[1], forecast.apex[1])  # never passes target_x: the apex
    assert float(target.time[1]) == pytest.approx(0.6)
    assert target.something_to_hit.tolist() == [False, True]


@pytest.mark.parametrize(
    ("position", "velocity", "expected"),
    [
        ((-1.0, 0, 1.0), (-4, 0, -1.0), False),
        ((-1.95, 0, 1.0), (-4, 0, 1.0), True),
        ((-1.0, 0, 1.0), (3, 0, 1.0), True),
        ((-1.0, 0, 0.65), (-4, 0, 1.0), True),
        ((-1.5, 0, 1.0), (-4, 0, -0.1), True),
        ((-1.5, 0, 1.0), (-4, 0, 0.1), False),
    ],
)
def test_nothing_to_hit(position: tuple[float, ...], velocity: tuple[float, ...], expected: bool) -> None:
    serve = Serve()
    serve.ball.position.copy_(torch.tensor([position]))
    serve.ball.velocity.copy_(torch.tensor([velocity]))
    serve.game.close()
    assert bool(serve.game.target.something_to_hit) is not expected


def test_nothing_to_hit_after_a_contact() -> None:
    serve = Serve().step(**BOUNCE)
    assert serve.game.target.something_to_hit
    assert not serve.step(**HIT).game.target.something_to_hit
    assert not Serve().step(**HIT).game.target.something_to_hit


def test_closeness_counts_only_while_the_ball_can_be_hit() -> None:
    serve = Serve().step(distance=0.1)  # before the bounce
    closeness = serve.closeness
    assert float(closeness.nearest) == math.inf
    serve.step(distance=0.5, **BOUNCE).step(distance=0.3).step(distance=0.4)
    assert float(closeness.nearest) == pytest.approx(0.3)
    serve.game.clock.time.fill_(0.68)
    serve.step(distance=0.35)
    assert bool(closeness.arrived_now)
    serve.step(distance=0.008, **HIT)
    assert not bool(closeness.arrived_now)  # once a serve
    assert float(closeness.nearest) == pytest.approx(0.008)
    serve.step(distance=0.001)  # after the hit
    assert float(closeness.nearest) == pytest.approx(0.008)


def test_an_early_hit_is_an_arrival() -> None:
    serve = Serve().step(distance=0.01, **BOUNCE)
    assert not bool(serve.closeness.arrived_now)
    assert bool(serve.step(distance=0.01, **HIT).closeness.arrived_now)


def test_serves_are_drawn_in_range() -> None:
    serve, everyone = config().serve, torch.ones(4000, dtype=torch.bool)
    position, velocity, spin = ServeSampler(serve, fake_ball(4000), torch.Generator().manual_seed(0)).sample(everyone)
    for value, low_high in zip(
        (*position.unbind(1), *velocity.unbind(1)),
        (serve.x, serve.y, serve.z, serve.vx, serve.vy, serve.vz),
        strict=True,
    ):
        low, high = low_high
        assert float(value.min()) >= low - 1e-6
        assert float(value.max()) <= high + 1e-6
        assert float(value.mean()) == pytest.approx(0.5 * (low + high), abs=0.03)
    assert not spin.any()


@pytest.mark.parametrize("velocity", [(-6.0, 0.0, 1.7), (-5.0, -0.8, -0.5), (3.0, 4.0, 0.0), (0.0, -2.0, 5.0)])
def test_spin_is_about_the_axes_of_the_flight(velocity: tuple[float, float, float]) -> None:
    flight = torch.tensor([velocity]).double()
    ahead = flight * torch.tensor([1.0, 1.0, 0.0])
    up, ahead, along = torch.tensor([[0.0, 0.0, 1.0]]).double(), ahead / ahead.norm(), flight / flight.norm()
    axes = torch.cat((torch.linalg.cross(up, ahead), up, along))
    about = torch.tensor([[30.0, -7.0, 11.0]])
    found = world_spin(torch.cat((torch.diag(about[0]), about)), flight.float().repeat(4, 1)).double()
    torch.testing.assert_close(found[:3], about.double().T * axes, atol=1e-5, rtol=1e-6)
    torch.testing.assert_close(found[3], (about.double().T * axes).sum(0), atol=1e-5, rtol=1e-6)
    left = torch.linalg.cross(up, ahead)
    lift = torch.linalg.cross(found[:3], flight.repeat(3, 1))  # direction of the Magnus force
    assert float(lift[0, 2]) < 0.0  # topspin bends the flight down,
    assert float((lift[1] * left).sum()) < 0.0  # sidespin of -7 rad/s to the right,
    assert float(lift[2].norm()) < 1e-4  # and a corkscrew nowhere


def test_topspin_of_a_ball_that_drops_straight_is_that_of_one_towards_the_robot() -> None:
    about = torch.tensor([[10.0, 0.0, 0.0], [0.0, 0.0, 3.0]])
    spin = world_spin(about, torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.0, 0.0]]))
    assert spin.tolist() == [[0.0, -10.0, 0.0], [-3.0, 0.0, 0.0]]


def sampled(count: int, *overrides: str) -> tuple[ServeSampler, BallSim, ServeConfig]:
    """Serves of ``serve=machine``, sampled once in all of ``count`` worlds."""
    task = config("serve=machine", *overrides)
    params, dt = BallParams.from_config(task.ball), task.robot.control_dt
    ball = BallSim(count, CPU, params, task.ball.table, dt, 1, task.engine.ball_dt)
    sampler = ServeSampler(task.serve, ball, torch.Generator().manual_seed(0))
    start = sampler.sample(torch.ones(count, dtype=torch.bool))
    ball.forecast(torch.ones(count, dtype=torch.bool), *start, -1.6)
    return sampler, ball, task.serve


def test_the_machine_serves_balls_that_land_on_the_robots_half() -> None:
    sampler, ball, serve = sampled(20000)
    forecast, velocity = ball.forecast_result, sampler.sample(torch.zeros(20000, dtype=torch.bool))[1]
    good = forecast.landing_own & ~forecast.net_touched
    limited = (velocity.norm(dim=1), forecast.bounce[:, 0], forecast.bounce[:, 1])
    for value, (low, high) in zip(limited, serve.limits().values(), strict=True):
        good &= (value >= low) & (value <= high)
    assert bool(good.all())
    assert bool(sampler.accepted.all())
    for column, name in enumerate(("topspin", "sidespin", "corkscrew")):
        assert sampler.about[:, column].abs().max() <= 60.0
        assert float(sampler.about[:, column].std()) == pytest.approx(120 / 12**0.5, rel=0.05), name


def test_one_more_attempt_resamples_the_bad_serves_alone() -> None:
    (twice, _, _), (more, _, _) = sampled(2000, "serve.attempts=2"), sampled(2000, "serve.attempts=3")
    nobody = torch.zeros(2000, dtype=torch.bool)
    kept = (twice.sample(nobody)[0] == more.sample(nobody)[0]).all(1)
    # those that two rounds accept, 1 - 0.6^2, and of the others those that the third does not
    assert pytest.approx(float(kept.float().mean()), abs=0.04) == 1.0 - 0.4 * 0.6**2


def test_a_world_that_finds_no_good_serve_repeats_its_last() -> None:
    sampler, _, _ = sampled(2000, "serve.attempts=2")
    everyone = torch.ones(2000, dtype=torch.bool)
    before, about = [part.clone() for part in sampler.launch], sampler.about.clone()
    after = sampler.sample(everyone)
    same = (after[0] == before[0]).all(1)
    assert float(same.float().mean()) == pytest.approx(0.6**2, abs=0.04)  # found none in two rounds
    for part, last in zip((*after, sampler.about), (*before, about), strict=True):
        assert torch.equal(part[same], last[same])
    assert bool(sampler.accepted.all())


def test_limits_that_no_serve_keeps_are_an_error() -> None:
    with pytest.raises(
        ConfigError, match=r"serve=machine: 5 of 5 worlds found no serve .* serve\.bounce_y=\[-0\.7, 0\.2\]"
    ):
        sampled(5, "serve.speed=[1.0,1.1]")


def test_limits_need_attempts() -> None:
    with pytest.raises(ConfigError, match=r"serve\.speed needs serve\.attempts above 1"):
        config("serve.speed=[4.0,5.0]")
    with pytest.raises(ConfigError, match=r"serve\.bounce_y: low 0\.5 is above high 0\.2"):
        config("serve=machine", "serve.bounce_y=[0.5,0.2]")


def test_poses_are_drawn_in_range_and_within_joint_limits() -> None:
    task = config()
    nominal = torch.linspace(-0.6, 0.6, 21)
    limits = (torch.full((21,), -0.8), torch.full((21,), 0.8))
    generator = torch.Generator().manual_seed(0)
    sampler = PoseSampler(task.reset, task.robot, 2000, nominal, limits, generator)
    qpos, qvel = sampler.sample(torch.ones(2000, dtype=torch.bool))
    assert qpos.shape == (2000, 28)
    assert qvel.shape == (2000, 27)
    torch.testing.assert_close(qpos[:, 3:7].norm(dim=1), torch.ones(2000))
    torch.testing.assert_close(qpos[:, 2], torch.full((2000,), 0.72))
    low, high = task.reset.base_x
    assert low - 1e-6 <= float(qpos[:, 0].min()) < low + 0.02
    assert high - 0.02 < float(qpos[:, 0].max()) <= high + 1e-6
    assert float(qpos[:, 7:].abs().max()) <= 0.8 + 1e-6
    hip = JOINT_NAMES.index("Right_Hip_Yaw")
    ratio = qpos[:, 7 + hip] / nominal[hip]
    assert 0.5 - 1e-5 <= float(ratio.min()) < 0.52
    elbow = JOINT_NAMES.index("Right_Elbow_Pitch")
    offset = qpos[:, 7 + elbow] - nominal[elbow]
    assert -0.5 - 1e-6 <= float(offset.min()) < -0.48
    assert not qvel[:, 6:].any()


@pytest.mark.parametrize(
    ("time", "z", "floor", "touch", "over"),
    [
        (0.5, 1.0, 0, math.inf, False),
        (1.8, 1.0, 0, math.inf, True),
        (0.5, 0.09, 0, math.inf, True),
        (0.5, 0.2, 1, math.inf, True),
        (1.3, 1.0, 0, 0.6, False),
        (1.41, 1.0, 0, 0.6, True),
    ],
)
def test_serves_end(time: float, z: float, floor: int, touch: float, over: bool) -> None:
    serve = Serve(True, "serve=train")
    serve.game.clock.time.fill_(time - 0.02)
    serve.ball.position[:, 2] = z
    serve.referee.touch_time.fill_(touch)
    serve.referee.touched.fill_(touch < 9.0)
    set_events(serve.ball.events, **({"floor": 0.01} if floor else {}))
    serve.game.judge()
    serve.game.close()
    assert bool(serve.ends.over) is over


def test_episodes_count_five_serves_and_first_ones_start_anywhere() -> None:
    game, worlds = fake_game(1000)
    clock = game.clock
    everyone = torch.ones(1000, dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    game.start_episode(everyone, generator)
    assert set(clock.index.tolist()) == {0.0, 1.0, 2.0, 3.0, 4.0}
    worlds.ball.position[:, 2] = 0.05
    game.close()
    torch.testing.assert_close(game.ends.truncated, clock.index == 4)
    game.start_episode(everyone, generator)
    assert not clock.index.any()
    game.count_serves()  # all are over
    clock.time.fill_(0.9)
    state = TaskState(worlds, game, torch.zeros(worlds.num_worlds))
    state.derive()
    assert float(state.serve_progress[0]) == pytest.approx(0.5)
    assert float(state.episode_progress[0]) == pytest.approx(1.5 / 5)


def test_endless_play_has_no_last_serve() -> None:
    game, worlds = fake_game(3, config("serve=mixed"))
    game.start_episode(torch.ones(3, dtype=torch.bool), torch.Generator())
    assert not game.clock.index.any()
    game.clock.index.fill_(1000.0)
    worlds.ball.position[:, 2] = 0.05
    game.close()
    assert game.ends.over.all()
    assert not game.ends.truncated.any()
    state = TaskState(worlds, game, torch.zeros(worlds.num_worlds))
    state.derive()
    assert not state.episode_progress.any()


def test_lost_positions() -> None:
    game, worlds = fake_game(6)
    standing, fallen, far = [-1.8, 0.0, 0.7], [-1.8, 0.0, 0.49], [-3.7, 0.0, 0.7]
    near, left, right = [-1.3, 0.0, 0.7], [-1.8, 1.2, 0.7], [-1.8, -1.2, 0.7]
    worlds.robot.base_position.copy_(torch.tensor([standing, fallen, far, near, left, right]))
    game.close()
    assert game.ends.lost.tolist() == [False, True, True, True, True, True]
