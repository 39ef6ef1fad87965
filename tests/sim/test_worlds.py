"""Worlds: delays, pushes, randomisation and the paddle's reaction, against numbers."""

from __future__ import annotations

import pytest
import torch

from pace.config.base import ConfigError
from pace.config.task import TaskConfig
from pace.config.training import load_train_config
from pace.sim.worlds import Worlds

CLEAN = ["randomization=none", "engine=native", "engine.physics_dt=0.005"]


def make_worlds(num_worlds: int = 4, *overrides: str) -> Worlds:
    config: TaskConfig = load_train_config([*CLEAN, *overrides])
    return Worlds(config, num_worlds, "cpu", torch.Generator().manual_seed(3))


def stand(worlds: Worlds) -> None:
    """All robots in the nominal pose, feet on the floor."""
    n = worlds.num_worlds
    qpos = torch.zeros(n, 28)
    qpos[:, 0], qpos[:, 2], qpos[:, 3] = -2.0, 0.70, 1.0
    qpos[:, 7:] = worlds.nominal
    worlds.reset_robot(torch.ones(n, dtype=torch.bool), qpos, torch.zeros(n, 27))


def test_targets_arrive_after_the_actuator_delay() -> None:
    worlds = make_worlds(1)
    stand(worlds)
    worlds.randomizer.actuator_delay.fill_(0.007)
    worlds.actuation.sample()
    # 7 ms into physics steps of 5 ms: nothing, 3 of 5 ms, all, all
    share = (worlds.actuation(worlds.nominal + 0.1)[0, :, 0] - worlds.nominal[0]) / 0.1
    torch.testing.assert_close(share, torch.tensor([0.0, 0.6, 1.0, 1.0]), atol=1e-5, rtol=0.0)


def test_a_delay_of_more_than_a_control_step_is_the_targets_moved_in_time() -> None:
    """The mean over each physics step of the targets' steps, 33 ms late, sampled finely."""
    worlds = make_worlds(1, "randomization.actuator_delay=[0.033,0.033]")
    stand(worlds)
    given = torch.tensor([0.1, -0.2, 0.3, 0.05, 0.0])
    played = torch.cat([worlds.actuation(worlds.nominal + value)[0, :, 0].clone() for value in given])
    instants = (torch.arange(5 * 20 * 10) + 0.5) / 10.0 - 33.0  # ms, ten a millisecond
    index = torch.div(instants, 20.0, rounding_mode="floor").long()
    late = torch.where(index < 0, 0.0, given[index.clamp(min=0)]).view(20, 50).mean(1)
    torch.testing.assert_close(played - worlds.nominal[0], late, atol=1e-6, rtol=0.0)


def test_older_targets_are_saved_with_the_worlds() -> None:
    worlds = make_worlds(2, "randomization.actuator_delay=[0.033,0.033]")
    stand(worlds)
    for value in (0.1, -0.2):
        worlds.step(worlds.nominal.repeat(2, 1) + value)
    saved = {name: tensor.clone() for name, tensor in worlds.state_dict().items()}
    worlds.step(worlds.nominal.repeat(2, 1))
    expected = worlds.engine.qpos_path.clone()
    again = make_worlds(2, "randomization.actuator_delay=[0.033,0.033]")
    again.load_state_dict(saved)
    again.step(again.nominal.repeat(2, 1))
    assert torch.equal(again.engine.qpos_path, expected)


def test_a_delay_longer_than_four_control_steps_is_refused() -> None:
    with pytest.raises(ConfigError, match="actuator_delay"):
        make_worlds(1, "randomization.actuator_delay=[0.0,0.081]")


def test_play_takes_its_half_from_the_way_of_the_motor() -> None:
    worlds = make_worlds(3, "randomization.backlash=[0.02,0.02]")
    stand(worlds)
    offset = torch.tensor([[0.1], [-0.1], [0.008]])  # rad from where the joints are
    played = worlds.actuation(worlds.nominal + offset)[:, -1]
    expected = torch.tensor([[0.09], [-0.09], [0.0]])
    torch.testing.assert_close(played - worlds.nominal, expected.expand_as(played), atol=1e-6, rtol=0.0)


def test_the_paddle_is_tilted_and_shifted_in_a_direction_of_each_world() -> None:
    """Its angle to the model's face and distance from the model's centre; all directions occur."""
    count = 400
    worlds = make_worlds(count, "randomization.paddle_tilt=[0.05,0.05]", "randomization.paddle_shift=[0.01,0.01]")
    straight = make_worlds(count)
    for each in (worlds, straight):
        stand(each)
    moved, normal = worlds.robot.paddle_position - straight.robot.paddle_position, worlds.robot.paddle_normal
    torch.testing.assert_close(moved.norm(dim=1), torch.full((count,), 0.01), atol=1e-6, rtol=0.0)
    cosine = (normal * straight.robot.paddle_normal).sum(1)
    torch.testing.assert_close(cosine, torch.full((count,), 0.99875026), atol=1e-6, rtol=0.0)
    # uniform over directions: the mean of a unit vector of M samples has a standard deviation of sqrt(1 / M)
    assert moved.mean(0).norm() / 0.01 < 3.0 / count**0.5
    assert (normal - straight.robot.paddle_normal).mean(0).norm() / 0.05 < 3.0 / count**0.5


@pytest.mark.parametrize(
    ("name", "low"),
    [("speed_scale", 0.0), ("ankle_effort_scale", 0.0), ("joint_friction", -0.1), ("joint_damping", -1.0)],
)
def test_ranges_that_no_motor_or_joint_has_are_refused(name: str, low: float) -> None:
    with pytest.raises(ConfigError, match=rf"randomization\.{name}"):
        load_train_config([f"randomization.{name}=[{low},1.0]"])


def test_randomised_parameters_stay_in_range_and_change_only_masked_worlds() -> None:
    ranges = {"speed_scale": (0.4, 1.8), "ankle_effort_scale": (0.7, 1.0), "joint_friction": (0.1, 0.5)}
    ranges["joint_damping"] = (0.0, 0.3)
    given = [f"randomization.{name}=[{low},{high}]" for name, (low, high) in ranges.items()]
    config = load_train_config(["randomization=moderate", "engine=native", *given])
    worlds = Worlds(config, 64, "cpu")
    before = {name: value.clone() for name, value in worlds.randomizer.state_dict().items()}
    mask = torch.arange(64) % 2 == 0
    worlds.randomizer.sample(mask)
    nominal = config.ball.paddle_restitution
    low, high = (nominal + x for x in config.randomization.paddle_restitution)
    after = worlds.randomizer.state_dict()
    assert after["ball.paddle_restitution"].min() >= low - 1e-6
    assert after["ball.paddle_restitution"].max() <= min(high, 1.0) + 1e-6
    for name, (least, most) in ranges.items():
        values = after[f"engine.{name}"]
        assert least <= values.min() < values.max() <= most
    for name, value in after.items():
        assert torch.equal(value[~mask], before[name][~mask]), name
        low, high = value.min(), value.max()
        assert (high == low) or not torch.equal(value[mask], before[name][mask]), name


def test_states_of_another_shape_are_refused_by_name() -> None:
    worlds = make_worlds(4)
    everyone = torch.ones(4, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"qpos must have shape \(4, 28\), not \(1, 28\)"):
        worlds.reset_robot(everyone, torch.zeros(1, 28), torch.zeros(4, 27))
    with pytest.raises(ValueError, match=r"velocity must have shape \(4, 3\), not \(1, 3\)"):
        worlds.serve(everyone, torch.zeros(4, 3), torch.zeros(1, 3), torch.zeros(4, 3))


def test_pushes_come_in_their_interval_and_size() -> None:
    worlds = make_worlds(256, "randomization.push_velocity=[-0.2,0.2]", "randomization.push_interval=[1.0,2.0]")
    steps, pushes, largest = 200, 0, 0.0
    for _ in range(steps):
        push = worlds.randomizer.update_push()
        pushes += int((push.abs().sum(1) > 0).sum())
        largest = max(largest, float(push.abs().max()))
    # renewal process with intervals U(1, 2): E[N(t)] = t / mean + (variance - mean^2) / (2 mean^2)
    expected = steps * worlds.control_dt / 1.5 + (1 / 12 - 1.5**2) / (2 * 1.5**2)
    assert pushes / 256 == pytest.approx(expected, rel=0.1)
    assert 0.19 < largest <= 0.2


def test_gravity_and_heading_of_a_turned_base() -> None:
    worlds = make_worlds(2)
    n = worlds.num_worlds
    qpos = torch.zeros(n, 28)
    qpos[:, 2] = 1.5
    half = torch.tensor(0.25)
    qpos[0, 3], qpos[0, 6] = torch.cos(half), torch.sin(half)  # yaw 0.5
    qpos[1, 3], qpos[1, 5] = torch.cos(half), torch.sin(half)  # pitch 0.5
    worlds.reset_robot(torch.ones(n, dtype=torch.bool), qpos, torch.zeros(n, 27))
    cos, sin = torch.cos(torch.tensor(0.5)), torch.sin(torch.tensor(0.5))
    torch.testing.assert_close(worlds.robot.heading, torch.tensor([[cos, sin], [1.0, 0.0]]))
    expected = torch.tensor([[0.0, 0.0, -1.0], [sin, 0.0, -cos]])
    torch.testing.assert_close(worlds.robot.projected_gravity, expected, atol=1e-6, rtol=0)


def test_the_ball_pushes_the_paddle_back() -> None:
    """A fast ball on a resting paddle: with the reaction the paddle moves with the ball, without it it does not."""
    speeds = []
    for reaction in ("true", "false"):
        worlds = make_worlds(1, f"engine.paddle_reaction={reaction}")
        stand(worlds)
        target = worlds.nominal.repeat(1, 1)
        normal = worlds.robot.paddle_normal.clone()
        start = worlds.robot.paddle_position + 0.12 * normal
        worlds.serve(torch.ones(1, dtype=torch.bool), start, -10.0 * normal, torch.zeros(1, 3))
        worlds.step(target)
        assert int(worlds.ball.events.paddle_hit) == 1
        worlds.step(target)
        speeds.append(float((worlds.robot.paddle_velocity * normal).sum()))
    assert speeds[0] < speeds[1] - 0.02


def test_the_reaction_acts_where_the_ball_touched() -> None:
    """World 0: a hit, at the same place of the blade; world 1: a resting ball, where it lay at the step's end."""
    worlds = make_worlds(2)
    stand(worlds)
    events, paddle = worlds.ball.events, worlds.robot.paddle_position
    events.paddle_impulse.copy_(torch.tensor([0.01, -0.004, 0.006]).expand(2, 3))
    events.paddle_hit[0] = 1
    events.hit_offset[0] = torch.tensor([0.03, 0.0, 0.06])
    events.hit_position[0] = torch.tensor([9.0, 0.0, 0.0])  # the paddle has moved on since
    events.hit_point[0] = torch.tensor([8.98, 0.0, 0.0])
    events.impulse_point[1] = paddle[1] + torch.tensor([0.0, 0.02, 0.05])
    worlds._react()
    force = events.paddle_impulse / worlds.control_dt
    points = torch.stack([paddle[0] + torch.tensor([0.01, 0.0, 0.06]), events.impulse_point[1]])
    torch.testing.assert_close(worlds._applied[:, :3], force)
    torque = torch.linalg.cross(points - worlds.robot.base_position, force)  # the base stands upright
    torch.testing.assert_close(worlds._applied[:, 3:6], torque)


def test_dropped_contacts_are_warned_of_once() -> None:
    options = ["engine=mjwarp", "engine.contacts_per_world=2", "engine.constraints_per_world=8"]
    worlds = make_worlds(1, *options)
    stand(worlds)
    worlds.warn_of_overflow()  # nothing yet
    for _ in range(5):  # it comes down on its feet
        worlds.step(worlds.nominal.repeat(1, 1))
    with pytest.warns(RuntimeWarning, match=r"contacts_per_world \(2\).*constraints_per_world \(8\)"):
        worlds.warn_of_overflow()
    worlds.warn_of_overflow()


def test_state_dict_restores_the_next_step_exactly() -> None:
    config = load_train_config(["engine=native"])
    worlds = Worlds(config, 8, "cpu", torch.Generator().manual_seed(1))
    stand(worlds)
    targets = worlds.nominal + 0.1 * torch.randn(8, 21)
    worlds.step(targets)
    state = {name: value.clone() for name, value in worlds.state_dict().items()}
    random_state = worlds.generator.get_state()
    worlds.step(targets)
    expected = worlds.engine.qpos_path[:, -1].clone()
    other = Worlds(config, 8, "cpu", torch.Generator().manual_seed(2))
    other.load_state_dict(state)
    other.generator.set_state(random_state)
    other.step(targets)
    assert torch.equal(other.engine.qpos_path[:, -1], expected)
