"""Each reward term against a number worked out by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.task import RewardConfig, RewardTerm
from pace.sim.ball.aero import GRAVITY
from pace.sim.ball.ball import BallParams, BallSim
from pace.task.ball_rewards import paddle_speed
from pace.task.rewards import TERMS, RewardFunction, RewardManager
from pace.task.state import JOINT_GROUPS, TaskState
from tests.helpers.fakes import CPU, config, fake_state, set_events
from tests.helpers.recipes import recipe
from tests.helpers.robot import JOINT_NAMES, SPEC

PAPER_TASK = config("reward=paper")
PAPER = PAPER_TASK.reward
PACE = config().reward


def value(name: str, state: TaskState, reward: RewardConfig = PAPER) -> float:
    state.refresh()
    result = TERMS[name].function(state, reward.terms[name].params)
    assert result.shape == (state.action.shape[0],)
    return float(result[0])


def hit(state: TaskState, distance: float = 0.0275) -> None:
    """A legal hit at ``distance`` of the ball's centre from the face's centre."""
    for times in ({"own_bounce": 0.01}, {"paddle_hit": 0.01}):
        play(state, distance, **times)


def play(state: TaskState, distance: float, **times: Any) -> None:
    set_events(state.ball.events, **times)
    state.ball.nearest_paddle_distance.fill_(distance)
    state.game.judge()
    state.game.close()


def test_every_term_of_the_paper_is_there_and_every_term_is_tested() -> None:
    assert set(PACE.terms) | {"swing", "ready_joints", "ready_height"} == set(TERMS)
    assert set(PACE.terms) - set(PAPER.terms) == {"arrival", "ready_stance", "return_velocity"}


def test_measures_are_the_torch_formulas_on_random_states() -> None:
    torch.manual_seed(2)
    state = fake_state(7, PAPER_TASK)
    robot = state.robot
    for tensor in (*vars(robot).values(), state.action, state.previous_action):
        tensor.normal_(std=2.0)
    robot.foot_force[0, 0] = torch.tensor([0.1, 0.2, 0.3])  # less than a contact
    state.refresh()
    action = state.action - state.previous_action
    watts, deviation = robot.joint_torque * robot.joint_velocity, (robot.joint_position - state.nominal).abs()
    groups = {name: torch.tensor([float(joint in SPEC.groups[name]) for joint in JOINT_NAMES]) for name in JOINT_GROUPS}
    horizontal = robot.foot_force[..., :2].norm(dim=-1) / robot.foot_force[..., 2].abs()
    expected = {
        "joint_power": watts.norm(dim=1),
        "ankle_power": (watts * groups["ankles"]).norm(dim=1),
        "joint_acceleration": robot.joint_acceleration.square().sum(1),
        "action_change": action.square().sum(1),
        "foot_tilt": robot.foot_up[..., :2].square().sum((1, 2)),
        "foot_slide": (robot.foot_velocity[..., :2].norm(dim=-1) * state.foot_contact).sum(1),
        "foot_steepness": (horizontal * state.foot_contact).amax(1),
        "paddle_to_head": (robot.paddle_position - robot.head_position).norm(dim=1),
        "paddle_to_target": (robot.paddle_position - state.game.target.point).norm(dim=1),
        "base_to_target": state.base_error.norm(dim=1),
        "vertical_velocity": robot.base_linear_velocity[:, 2].square(),
        "roll_pitch_rate": robot.base_angular_velocity[:, :2].square().sum(1),
        "yaw_rate": robot.base_angular_velocity[:, 2].square(),
        "base_tilt": robot.projected_gravity[:, :2].square().sum(1),
        "contacts": robot.body_contact.sum(1),
        "feet_down": state.foot_contact.sum(1).float(),
    }
    expected |= {name: deviation @ groups[name] for name in groups if name != "ankles"}
    assert state.measures.keys() == expected.keys()
    assert state.foot_contact.any()
    assert not state.foot_contact.all()
    for name, numbers in expected.items():
        torch.testing.assert_close(state.measures[name], numbers)


def test_paddle_to_target() -> None:
    state = fake_state(1, PAPER_TASK)
    state.robot.paddle_position.copy_(state.game.target.point + torch.tensor([0.0, 0.3, 0.4]))
    assert value("paddle_to_target", state) == pytest.approx(math.exp(-0.5 / 0.25))
    state.robot.paddle_position.copy_(state.game.target.point)
    assert value("paddle_to_target", state) == pytest.approx(math.exp(-0.15 / 0.25))
    state.ball.velocity[:, 0] = 3.0
    assert value("paddle_to_target", state) == 0.0


def test_base_to_target() -> None:
    state = fake_state(1, PAPER_TASK)  # target (-1.6, 0.1): base target (-1.7, 0.7), base (-1.8, 0.3)
    assert value("base_to_target", state) == pytest.approx(math.exp(-math.hypot(0.1, 0.4) / 0.25))
    state.ball.velocity[:, 0] = 3.0  # nothing to hit: the base stands on its idle place
    assert value("base_to_target", state) == pytest.approx(math.exp(-0.05 / 0.25))


def test_base_velocity() -> None:
    state = fake_state(1, PAPER_TASK)  # wanted 4 * (0.1, 0.4)
    state.robot.base_linear_velocity[:] = torch.tensor([0.4, 0.6, 5.0])
    assert value("base_velocity", state) == pytest.approx(math.exp(-1.0 / 1.44))
    state.robot.base_position[:, 1] = -9.0
    state.robot.base_linear_velocity[:] = torch.tensor([0.4, 7.0, 0.0])  # clipped at 7 m/s
    assert value("base_velocity", state) == pytest.approx(math.exp(-0.1 / 1.44))


def test_contact_pays_the_best_closeness_once() -> None:
    state = fake_state()
    paid = []
    for distance, times in (
        (0.5, {"own_bounce": 0.01}),
        (0.06, {}),
        (0.065, {}),
        (0.0275, {"paddle_hit": 0.01}),
        (0.02, {}),
    ):
        play(state, distance, **times)
        paid.append(value("contact", state))
    assert paid == pytest.approx([0.0, 0.2, 0.0, 0.65, 0.0], abs=1e-5)
    assert sum(paid) == pytest.approx((0.05 - 0.0075) / 0.05)


def test_no_contact_reward_for_a_volley() -> None:
    state = fake_state()
    play(state, 0.0275, paddle_hit=0.01)
    assert value("contact", state) == 0.0
    play(state, 0.0275, own_bounce=0.01)
    assert value("contact", state) == 0.0


def test_arrival_is_paid_when_the_ball_is_due_or_hit() -> None:
    state = fake_state()
    play(state, 0.5, own_bounce=0.01)
    play(state, 0.17)
    assert value("arrival", state, PACE) == 0.0
    state.game.clock.time.fill_(0.68)
    play(state, 0.32)
    assert value("arrival", state, PACE) == pytest.approx(math.exp(-0.15 / 0.15), rel=1e-5)
    play(state, 0.1)
    assert value("arrival", state, PACE) == 0.0
    early = fake_state()
    hit(early)
    assert value("arrival", early, PACE) == pytest.approx(math.exp(-0.0075 / 0.15), rel=1e-4)


def test_predicted_landing() -> None:
    state = fake_state()
    hit(state)
    assert value("predicted_landing", state) == 0.0  # no landing in the forecast
    state.game.returns.landing[:] = torch.tensor([0.85, 0.4, 0.78])
    assert value("predicted_landing", state) == pytest.approx(3.0 - 0.5)
    play(state, 0.5)
    assert value("predicted_landing", state) == 0.0  # once


def test_return_velocity() -> None:
    state = fake_state()
    hit(state)
    events = state.ball.events
    events.hit_position[:] = torch.tensor([-1.5, 0.2, 1.03])
    flight, aim, gravity = 0.5, torch.tensor([1.5, 0.0, 0.78]), torch.tensor([0.0, 0.0, -9.81])
    good = (aim - events.hit_position[0] - 0.5 * gravity * flight**2) / flight
    assert torch.allclose(good, torch.tensor([6.0, -0.4, 1.9525]))
    events.hit_velocity_out[:] = good
    assert value("return_velocity", state, PACE) == pytest.approx(1.0, abs=1e-6)
    events.hit_velocity_out[:] = good + torch.tensor([-2.0, 1.0, -2.0])  # 3 m/s off
    assert value("return_velocity", state, PACE) == pytest.approx(1.0 - 3.0 / 8.0, rel=1e-5)
    events.hit_velocity_out[:] = torch.tensor([-3.0, 0.0, -2.0])
    assert value("return_velocity", state, PACE) == 0.0
    play(state, 0.5)
    assert value("return_velocity", state, PACE) == 0.0  # once


def swung(arriving: Tensor, point: Tensor, speed: Tensor, normal: Tensor, params: BallParams) -> Tensor:
    """Velocity of a ball that met a paddle at ``point`` which moves along its normal: the simulation's own rebound."""
    table, dt = config().ball.table, 0.02
    sim = BallSim(1, CPU, params, table, dt, 1, 0.004)
    fall = torch.tensor([0.0, 0.0, GRAVITY]) * 0.5 * dt
    sim.position[:], sim.velocity[:] = point - 0.5 * dt * (arriving + 0.5 * fall), arriving + fall
    gap = 0.02 + table.paddle_half_thickness
    path = torch.zeros(1, 2, 12)
    for knot, time in enumerate((-0.5 * dt, 0.5 * dt)):
        path[0, knot] = torch.cat(
            [point - gap * normal + time * speed * normal, normal, speed * normal, torch.zeros(3)]
        )
    sim.fly(path)
    assert sim.events.paddle_hit[0] == 1
    return sim.events.hit_velocity_out[0]


def test_a_perfect_swing_is_one_that_returns_the_ball() -> None:
    reward = recipe("swing").reward
    state = fake_state()
    material = BallParams.from_config(config().ball)
    material = replace(material, paddle_friction=0.0, table_drag=0.0, table_lift=0.0)  # no air, no grip
    state.ball.params = material
    target, robot = state.game.target, state.robot
    target.arriving[:] = torch.tensor([-4.2, 0.3, -0.5])
    target.point[:], target.time[:] = torch.tensor([-1.6, -0.2, 1.1]), float(state.game.clock.time[0])
    wanted = torch.tensor([6.2, 0.4, 1.8125])  # to (1.5, 0, 0.78) in 0.5 s, worked out as in test_return_velocity
    change = wanted - target.arriving[0]
    normal = change / change.norm()
    speed = paddle_speed(target.arriving, normal[None], change.norm()[None], material)[0]
    assert 0.5 < speed < 4.0
    out = swung(target.arriving[0], target.point[0], speed, normal, material)
    torch.testing.assert_close(out, wanted, atol=1e-3, rtol=0.0)
    robot.paddle_normal[:], robot.paddle_velocity[:] = normal, speed * normal
    assert value("swing", state, reward) == pytest.approx(1.0, abs=1e-5)
    robot.paddle_normal[:] = -normal
    assert value("swing", state, reward) == pytest.approx(1.0, abs=1e-5)  # the back of the blade returns as well
    robot.paddle_velocity[:] = speed * normal + torch.tensor([0.0, 2.0, 0.0])
    assert value("swing", state, reward) == pytest.approx(0.75, abs=1e-5)
    target.time[:] += 0.1
    assert value("swing", state, reward) == pytest.approx(0.75 * math.exp(-1), abs=1e-5)
    state.something_to_hit[:] = False
    assert float(TERMS["swing"].function(state, reward.terms["swing"].params)[0]) == 0.0


def test_predicted_net_height() -> None:
    state = fake_state()
    hit(state)
    assert value("predicted_net_height", state) == 0.0
    state.game.returns.net_height[:] = 0.91
    assert value("predicted_net_height", state) == pytest.approx(math.exp(-0.5))
    play(state, 0.5)
    assert value("predicted_net_height", state) == 0.0


def test_illegal_hits_pay_neither_landing_nor_net_nor_success() -> None:
    state = fake_state()
    state.game.returns.landing[:] = torch.tensor([1.15, 0.0, 0.78])
    state.game.returns.net_height[:] = 1.11
    state.game.returns.lands_opponent[:] = True
    play(state, 0.0275, paddle_hit=0.01)
    for name in ("predicted_landing", "predicted_net_height", "success"):
        assert value(name, state) == 0.0
    for name in ("return_velocity", "success"):
        assert value(name, state, PACE) == 0.0


def test_success_when_it_lands_or_at_the_hit() -> None:
    state = fake_state()
    hit(state)
    state.game.returns.lands_opponent[:] = True
    assert value("success", state, PAPER) == 0.0
    assert value("success", state, PACE) == 1.0
    play(state, 1.0, opponent_bounce=0.01)
    assert value("success", state, PAPER) == 1.0
    assert value("success", state, PACE) == 0.0
    play(state, 1.0, opponent_bounce=0.01)
    assert value("success", state, PAPER) == 0.0


def test_unstable_hit() -> None:
    state = fake_state()
    hit(state)
    assert value("unstable_hit", state) == 0.0
    state.robot.foot_force[:, 1] = 0.0
    assert value("unstable_hit", state) == 1.0
    play(state, 0.5)
    assert value("unstable_hit", state) == 0.0


def _set(name: str, numbers: Any) -> Callable[[TaskState], None]:
    def change(state: TaskState) -> None:
        getattr(state.robot, name).copy_(torch.tensor(numbers))

    return change


def _joint(tensor: str, joint: str, number: float) -> Callable[[TaskState], None]:
    def change(state: TaskState) -> None:
        getattr(state.robot, tensor)[:, JOINT_NAMES.index(joint)] = number

    return change


def _still(state: TaskState) -> None:
    state.robot.joint_position.copy_(state.nominal)


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("base_vertical_velocity", [_set("base_linear_velocity", [3.0, 4.0, 0.5])], 0.25),
        ("base_roll_pitch_rate", [_set("base_angular_velocity", [0.5, -1.0, 3.0])], 1.25),
        ("base_yaw_rate", [_set("base_angular_velocity", [0.5, -1.0, 3.0])], 9.0),
        ("base_tilt", [_set("projected_gravity", [0.3, -0.4, -0.866])], 0.25),
        ("table_proximity", [_set("base_position", [-1.52, 0.0, 0.7])], 1.0),
        ("table_proximity", [_set("base_position", [-1.5249, 0.0, 0.7])], math.exp(-1.0)),
        ("undesired_contact", [_set("body_contact", [1.0, 0.0, 1.0, 0.0, 0.0, 0.0])], 2.0),
        ("paddle_near_head", [_set("paddle_position", [-1.8, 0.3, 0.95])], 0.1),
        ("paddle_near_head", [], 0.0),
        ("joint_acceleration", [_set("joint_acceleration", [2.0] * 21)], 84.0),
        ("deviation_hip_waist_left_arm", [_still], 0.0),
        ("deviation_hip_waist_left_arm", [_still, _joint("joint_position", "Waist", 0.1)], 0.2),  # nominal -0.1
        ("deviation_hip_waist_left_arm", [_still, _joint("joint_position", "Left_Shoulder_Roll", 0.0)], 0.0),
        ("deviation_left_shoulder_roll", [_still, _joint("joint_position", "Left_Shoulder_Roll", 0.0)], 0.45),
        ("deviation_right_arm", [_still, _joint("joint_position", "Right_Elbow_Yaw", 0.0)], 0.15),
        ("deviation_right_arm", [_still, _joint("joint_position", "Left_Elbow_Yaw", 0.0)], 0.0),
        ("joint_limits", [_still, _joint("joint_position", "Waist", 0.95)], 0.05),
        ("joint_limits", [_still, _joint("joint_position", "Waist", -1.0)], 0.1),
        ("both_feet_air", [], 0.0),
        ("both_feet_air", [_set("foot_force", [[0.0, 0.0, 0.2], [0.0, 0.0, 0.0]])], 1.0),
        ("foot_tilt", [_set("foot_up", [[0.1, 0.2, 0.97], [0.0, 0.3, 0.95]])], 0.14),
        ("foot_slide", [_set("foot_velocity", [[0.3, 0.4, 1.0], [0.0, 0.1, 0.0]])], 0.6),
        ("foot_force", [_set("foot_force", [[0.0, 300.0, 400.0], [0.0, 0.0, 620.0]])], 120.0),
        ("foot_force", [_set("foot_force", [[0.0, 0.0, 600.0], [0.0, 0.0, 2000.0]])], 500.0),
        ("feet_near", [_set("foot_position", [[-1.8, 0.3, 0.0], [-1.8, 0.2, 0.0]])], 0.1),
        ("feet_too_near", [_set("foot_position", [[-1.8, 0.3, 0.0], [-1.8, 0.2, 0.0]])], 0.05),
        ("feet_near", [], 0.0),
        ("foot_stumble", [_set("foot_force", [[60.0, 0.0, 10.0], [0.0, 0.0, 300.0]])], 1.0),
        ("foot_stumble", [_set("foot_force", [[40.0, 0.0, 10.0], [0.0, 0.0, 300.0]])], 0.0),
    ],
)
def test_terms_of_posture_joints_and_feet(
    name: str, changes: list[Callable[[TaskState], None]], expected: float
) -> None:
    state = fake_state()
    for change in changes:
        change(state)
    assert value(name, state) == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_foot_slide_needs_contact() -> None:
    state = fake_state()
    state.robot.foot_velocity[:, :, 0] = 1.0
    state.robot.foot_force[:, 0] = 0.0
    assert value("foot_slide", state) == pytest.approx(1.0)


def test_ready_stance_is_for_still_feet_at_the_idle_place_while_there_is_nothing_to_hit() -> None:
    state = fake_state()
    assert value("ready_stance", state, PACE) == 0.0  # a ball to hit
    state.ball.velocity[:, 0] = 1.0  # it moves away
    assert value("ready_stance", state, PACE) == pytest.approx(1.0)
    state.robot.foot_velocity[0, :, 0] = torch.tensor([0.06, -0.09])
    sigma = PACE.terms["ready_stance"].params["sigma"]
    assert value("ready_stance", state, PACE) == pytest.approx(math.exp(-0.15 / sigma))
    state.robot.base_position[:, 1] += PACE.terms["ready_stance"].params["reach"] + 0.01
    assert value("ready_stance", state, PACE) == 0.0


def test_ready_joints_and_height_are_for_the_same_time_and_place() -> None:
    terms = {
        "ready_joints": RewardTerm(1.0, {"reach": 0.3, "sigma": 0.5}),
        "ready_height": RewardTerm(-1.0, {"reach": 0.3, "height": 0.63}),
    }
    reward = replace(PACE, terms=PACE.terms | terms)
    state = fake_state()
    state.robot.base_position[:, 2] = 0.58
    assert (value("ready_joints", state, reward), value("ready_height", state, reward)) == (0.0, 0.0)  # a ball to hit
    state.ball.velocity[:, 0] = 1.0  # it moves away
    state.robot.joint_velocity.fill_(-0.25)
    assert value("ready_joints", state, reward) == pytest.approx(math.exp(-0.5))
    assert value("ready_height", state, reward) == pytest.approx(0.05)
    state.robot.base_position[:, 2] = 0.66
    assert value("ready_height", state, reward) == 0.0
    state.robot.base_position[:] += torch.tensor([0.0, 0.31, -0.1])
    assert (value("ready_joints", state, reward), value("ready_height", state, reward)) == (0.0, 0.0)


def test_power_of_all_joints_and_of_the_ankles() -> None:
    state = fake_state()
    _joint("joint_torque", "Left_Ankle_Roll", 3.0)(state)
    _joint("joint_velocity", "Left_Ankle_Roll", -2.0)(state)
    _joint("joint_torque", "Waist", 4.0)(state)
    _joint("joint_velocity", "Waist", 2.0)(state)
    assert value("joint_power", state) == pytest.approx(10.0)
    assert value("ankle_power", state) == pytest.approx(6.0)


def test_action_rate() -> None:
    state = fake_state()
    state.action.fill_(0.5)
    state.previous_action.fill_(0.3)
    assert value("action_rate", state) == pytest.approx(21 * 0.04, rel=1e-5)


def test_fall() -> None:
    state = fake_state()
    assert value("fall", state) == 0.0
    state.lost.fill_(True)
    assert value("fall", state) == 1.0


def test_the_manager_sums_weight_times_step_times_scale() -> None:
    manager = RewardManager(PACE, 2, CPU, 0.02)
    state = fake_state(2)
    state.robot.body_contact[0, :3] = 1.0
    for _ in range(2):
        state.refresh()
        manager.compute(state)
    weights = torch.tensor([PACE.terms[name].weight for name in manager.names])
    torch.testing.assert_close(manager.reward, 0.2 * 0.02 * (weights @ manager.values))
    sums = manager.pop_sums()
    assert float(sums["undesired_contact"]) == pytest.approx(2 * 3 * -80 * 0.02 * 0.2)
    torch.testing.assert_close(torch.stack(list(sums.values())).sum(), 2 * manager.reward.sum())
    assert float(manager.pop_sums()["undesired_contact"]) == 0.0


@pytest.mark.parametrize(
    ("name", "params", "message"),
    [
        ("jump", {}, "unknown reward term 'reward.terms.jump'"),
        ("contact", {}, r"reward.terms.contact.params misses \['reach'\]"),
        ("contact", {"reach": 0.05, "reech": 1.0}, r"does not know \['reech'\]"),
        ("contact", {"reach": -1e6}, r"params.reach must be positive, got -1000000.0"),  # the reward was infinite
        ("arrival", {"sigma": 0.0}, r"reward.terms.arrival.params.sigma must be positive, got 0.0"),
        (
            "arrival",
            {"sigma": 5e-324},
            r"reward.terms.arrival.params.sigma must be positive, got 5e-324",
        ),  # its square is 0
        (
            "return_velocity",
            {"x": 1.5, "y": 0.0, "z": 0.78, "time": 0.0, "reach": 8.0},
            r"params.time must be positive",
        ),
    ],
)
def test_wrong_terms_are_named(name: str, params: dict[str, float], message: str) -> None:
    reward = fresh_reward()
    reward.terms[name] = RewardTerm(1.0, params)
    with pytest.raises(ConfigError, match=message):
        RewardManager(reward, 1, CPU, 0.02)


def fresh_reward() -> RewardConfig:
    return replace(PACE, terms=dict(PACE.terms))


def test_a_wrong_shape_names_the_term(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TERMS, "fall", RewardFunction(lambda state, params: torch.zeros(3, 1), ()))
    manager = RewardManager(PACE, 2, CPU, 0.02)
    with pytest.raises(ValueError, match="reward term 'fall' has shape"):
        manager.compute(fake_state(2))


def test_all_terms_are_finite_at_the_start_of_a_serve_and_without_one() -> None:
    state = fake_state(3)
    state.ball.forecast_result.bounce_time[1] = torch.nan
    state.game.start_serve(torch.ones(3, dtype=torch.bool))
    manager = RewardManager(PACE, 3, CPU, 0.02)
    state.refresh()
    manager.compute(state)
    assert manager.values.isfinite().all()
