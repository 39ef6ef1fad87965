"""Quality of play of scripted robots: every measure against its closed form."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch

from pace.config.base import compose, parse
from pace.config.commands import EvaluateConfig
from pace.evaluation.quality import QualityRecorder, calm, landing, quantile, spread, strikes
from pace.evaluation.records import COLUMNS, C
from pace.evaluation.serves import ENDLESS, MakeRecorder, ServeRecorder, evaluate_row
from pace.rl.policies import built_in_policy
from pace.sim.robot import joint_gains, motor_lines
from pace.task.game import Outcome
from tests.helpers.saved import make_config

N, SERVES = 2, 1000
CONFIG = parse(compose("evaluate", ["policy=zero"]), EvaluateConfig).quality
STROKE = 15  # control steps of a stroke's end


class Scripted:
    """A recorder and the tensors that a test writes: robots at rest in the middle of their ranges, with a ball."""

    def __init__(self, warmup: int = 0) -> None:
        overrides = ["engine=native", "engine.threads=1", "reset=evaluation", "serve=mixed", *ENDLESS]
        self.env = env = built_in_policy("zero", 1).make_env(N, "cpu", 1, overrides)
        self.recorder = QualityRecorder(env, warmup, SERVES, CONFIG)
        robot = env.worlds.robot
        self.q, self.w, self.torque = robot.joint_position, robot.joint_velocity, robot.joint_torque
        self.base, self.before = robot.base_position, env.worlds.engine.qvel_path[:, -2, 6:]
        self.q.copy_(0.5 * (env.worlds.joint_lower + env.worlds.joint_upper).expand_as(self.q))
        for tensor in (self.w, self.torque, self.before, env.worlds.robot.base_linear_velocity):
            tensor.zero_()
        env.worlds.robot.body_contact.zero_()
        self.something, self.hit = env.task_state.something_to_hit, env.game.referee.hit_now
        self.over, self.down = env.game.ends.over, env.task_state.foot_contact
        self.something.fill_(True)
        self.down.fill_(True)

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            self.recorder.observe()

    def quality(self) -> dict:
        return self.recorder.quality()


@pytest.fixture
def scripted() -> Scripted:
    return Scripted()


def test_a_joint_at_an_end_of_its_range_counts_all_the_time(scripted: Scripted) -> None:
    worlds = scripted.env.worlds
    width = worlds.joint_upper - worlds.joint_lower
    scripted.q[:, 2] = worlds.joint_upper[2] - 0.019 * width[2]
    scripted.q[0, 5] = worlds.joint_lower[5] - 0.1  # beyond it
    scripted.q[:, 7] = worlds.joint_lower[7] + 0.021 * width[7]
    scripted.step(4)
    found = list(scripted.quality()["range_end"].values())
    assert (found[2], found[5], sum(found)) == (1.0, 0.5, 1.5)


def test_a_motor_is_at_its_limit_on_its_effort_and_on_its_line(scripted: Scripted) -> None:
    robot = make_config().robot
    lines = motor_lines(robot)
    assert lines is not None
    (speed, stall), effort = torch.tensor(lines, dtype=torch.float32), torch.tensor(joint_gains(robot)[2])
    scripted.env.worlds.engine.params.effort_scale.copy_(torch.tensor([1.0, 0.8]))
    cases = {  # joint: share of the greatest speed, torque, whether it is at the limit of worlds 0 and 1
        0: (0.0, float(effort[0]), (True, True)),
        1: (0.0, 0.9 * float(effort[1]), (False, True)),
        2: (0.9, 0.1 * float(stall[2]), (True, True)),
        3: (0.9, 0.09 * float(stall[3]), (False, True)),
        4: (0.9, -0.1 * float(stall[4]), (False, False)),  # it brakes
        5: (-0.9, -0.1 * float(stall[5]), (True, True)),
        6: (1.1, 0.0, (True, True)),  # faster than it can drive
    }
    for joint, (share, torque, _) in cases.items():
        scripted.before[:, joint], scripted.torque[:, joint] = share * speed[joint], torque
    scripted.step(3)
    found = list(scripted.quality()["torque_limit"].values())
    assert found[: len(cases)] == [sum(limit) / N for _, _, limit in cases.values()]
    assert sum(found[len(cases) :]) == 0.0


def test_a_sine_sways_by_its_standard_deviation(scripted: Scripted) -> None:
    scripted.something.fill_(False)
    period = round(CONFIG.sway_window / 0.02)
    amplitude = torch.tensor([0.01, 0.03])
    for step in range(3 * period):
        phase = 2 * math.pi * step / period
        scripted.base[:, 0] = -2.0 + amplitude * math.cos(phase)
        scripted.base[:, 1] = 0.3 + 0.5 * amplitude * math.sin(phase)
        scripted.step()
    mean_square = float((amplitude.double().square() * (0.5 + 0.125)).mean())
    assert scripted.quality()["sway"] == pytest.approx(math.sqrt(mean_square), rel=1e-3)
    assert scripted.recorder.sums.windows.tolist() == [3, 3]


def test_a_ball_in_play_interrupts_a_window_of_sway(scripted: Scripted) -> None:
    period = round(CONFIG.sway_window / 0.02)
    for something, steps in ((False, period - 1), (True, 1), (False, period - 1), (False, 1)):
        scripted.something.fill_(something)
        scripted.step(steps)
    assert scripted.recorder.sums.windows.tolist() == [1, 1]


def test_phases_have_their_own_means(scripted: Scripted) -> None:
    joints = scripted.w.shape[1]
    scripted.torque.fill_(2.0)

    def play(steps: int, speed: float, something: bool, hit: bool = False) -> None:
        scripted.something.fill_(something)
        scripted.w.fill_(speed)
        scripted.hit.fill_(hit)
        scripted.step(steps)

    play(10, 3.0, True)
    play(1, -2.0, False, hit=True)
    play(STROKE - 1, -2.0, False)
    play(25, 0.5, False)
    found = scripted.quality()
    assert [found[phase]["share"] for phase in found if phase in ("at_ball", "after_hit", "waiting")] == [0.2, 0.3, 0.5]
    for phase, speed in (("at_ball", 3.0), ("after_hit", 2.0), ("waiting", 0.5)):
        assert found[phase]["joint_speed"] == pytest.approx(speed)
        assert found[phase]["power"] == pytest.approx(2.0 * speed * joints)
        assert found[phase]["no_foot"] == 0.0


def test_hops_and_lifts_are_counted_as_such(scripted: Scripted) -> None:
    scripted.something.copy_(torch.tensor([True, False]))
    for down in ([[1, 1], [1, 1]], [[0, 0], [1, 1]], [[1, 1], [0, 1]], [[1, 1], [0, 1]]):
        scripted.down.copy_(torch.tensor(down, dtype=torch.bool))
        scripted.step()
    found = scripted.quality()
    assert (found["at_ball"]["no_foot"], found["waiting"]["no_foot"]) == (0.25, 0.0)
    assert found["at_ball"]["feet_lifted"] == pytest.approx(2 / (4 * 0.02))
    assert found["waiting"]["feet_lifted"] == pytest.approx(1 / (4 * 0.02))


def test_a_robot_is_calm_from_when_its_joints_stay_slow(scripted: Scripted) -> None:
    def serve(fast: list[bool]) -> None:
        """A hit, then steps in which the joints of world 0 are fast or not; the ball is down with the last."""
        for step, moving in enumerate(fast):
            scripted.hit.copy_(torch.tensor([step == 0, False]))
            scripted.w.fill_(1.01 if moving else 0.99)
            scripted.over.copy_(torch.tensor([step == len(fast) - 1, False]))
            scripted.recorder._watch()

    for _ in range(10):
        serve([True] * 4 + [False] * 6)
    serve([True, False, True, True, False, False])
    serve([False] * 5)
    assert scripted.recorder.calms.nonzero().flatten().tolist() == [0, 4]
    serve([False, False, True])
    found = calm(scripted.recorder.calms, 0.02)
    assert found["p50"] == pytest.approx(0.08)
    assert math.isnan(found["p95"])
    assert found["never"] == pytest.approx(1 / 13)


def test_height_and_its_percentiles(scripted: Scripted) -> None:
    for height in torch.linspace(0.5, 0.7, 401).tolist():
        scripted.base[:, 2] = height
        scripted.step()
    found = scripted.quality()["height"]
    assert found["mean"] == pytest.approx(0.6, abs=1e-5)
    assert (found["p5"], found["p95"]) == pytest.approx((0.51, 0.69), abs=1.1e-3)
    assert found["nominal"] == pytest.approx(scripted.env.worlds.model.key_qpos[0, 2])


def test_the_first_serves_are_left_out() -> None:
    scripted = Scripted(warmup=1)
    scripted.step(5)
    assert scripted.recorder.sums.instants.sum() == 0
    scripted.recorder.played += 1
    scripted.env.worlds.robot.body_contact[0, 1] = 1.0
    scripted.step(5)
    assert scripted.recorder.sums.instants.sum(1).tolist() == [5, 5]
    touches = scripted.quality()["touches"]
    assert touches == {name: 0.5 * (name == "head") for name in scripted.env.worlds.spec.contacts}
    scripted.recorder.counted += SERVES
    scripted.step(5)
    assert scripted.recorder.sums.instants.sum(1).tolist() == [5, 5]


def test_poses_are_sampled_over_the_row(scripted: Scripted) -> None:
    for step in range(40):
        scripted.q.fill_(float(step))
        scripted.step()
    assert scripted.recorder.poses()[:, 0].tolist() == [0.0, 0.0, 10.0, 10.0, 20.0, 20.0, 30.0, 30.0]


def test_a_quantile_is_linear_in_its_bin() -> None:
    counts = torch.tensor([0, 4, 0, 4])
    assert [quantile(counts, share) for share in (0.25, 0.5, 0.75, 1.0)] == [1.5, 2.0, 3.5, 4.0]
    assert math.isnan(quantile(torch.zeros(4), 0.5))
    found = spread(torch.cat((torch.arange(101.0), torch.tensor([torch.nan]))))
    assert found == pytest.approx({"p5": 5.0, "p50": 50.0, "p95": 95.0})
    assert math.isnan(calm(torch.zeros(9), 0.02)["never"])


def returned(points: list[tuple[float, float]]) -> torch.Tensor:
    """Successes that land at ``points``."""
    table = torch.full((len(points), len(COLUMNS)), torch.nan)
    table[:, C["outcome"]], table[:, C["hit"]] = Outcome.SUCCESS, 1.0
    table[:, [C["landing_x"], C["landing_y"]]] = torch.tensor(points)
    table[:, C["paddle_speed"]], table[:, C["speed_out"]], table[:, C["net_height"]] = 2.0, 6.0, 1.0
    return table


def test_where_the_successes_land() -> None:
    size = make_config().ball.table
    points = [(0.2, -0.6), (0.2, 0.6), (1.3, 0.0), (1.0, 0.7)]
    failed = returned([(0.5, 0.5)])
    failed[:, C["outcome"]] = Outcome.OUT
    found = landing(torch.cat((returned(points), failed)), size, 0.1)
    assert (found["x"], found["y"]) == pytest.approx((0.675, 0.175))
    assert found["std_x"] == pytest.approx(torch.tensor(points)[:, 0].std().item(), rel=1e-5)
    assert found["near_edge"] == 0.5  # 7 cm from the end, 6 cm from the left side
    assert found["zones"] == [[0.25, 0.0, 0.25], [0.0, 0.25, 0.25]]
    speeds = strikes(torch.cat((returned(points), failed)), 0.9)
    assert speeds["paddle_speed"]["p50"] == 2.0
    assert speeds["net_clearance"]["p5"] == pytest.approx(0.1)
    assert landing(failed, size, 0.1) == {}


def test_it_changes_nothing_of_the_play() -> None:
    def played(record: MakeRecorder) -> torch.Tensor:
        policy = built_in_policy("random", 2)
        quick = ["engine.physics_dt=0.02", "engine=native", "serve.max_duration=0.9"]
        row = evaluate_row(policy, "mixed", 8, 4, "cpu", 5, quick, 1, record=record)
        assert bool(row.quality) == (record is not ServeRecorder)
        return row.all_records.nan_to_num(-9.0)

    assert torch.equal(played(partial(QualityRecorder, config=CONFIG)), played(ServeRecorder))
