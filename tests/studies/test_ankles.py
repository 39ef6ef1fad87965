"""Ankles in the space of their motors: limits and inertia in closed form, and the engine that enforces the limits."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from pace.config.training import load_train_config
from pace.rl.policies import load_policy
from pace.sim.robot import compile_scene, describe_scene
from pace.studies import ankles
from tests.helpers.robot import JOINT_NAMES
from tests.helpers.saved import save_run

ONE = np.ones(1)


def limited(pitch: float, roll: float, pitch_speed: float = 0.0, roll_speed: float = 0.0) -> tuple[float, float]:
    given = ankles.within_limits((pitch * ONE, roll * ONE), (pitch_speed * ONE, roll_speed * ONE), ONE)
    return float(given[0][0]), float(given[1][0])


def test_the_motors_are_those_of_the_joints_limits() -> None:
    motor = ankles.motor()
    assert (motor.effort, motor.stall, motor.speed, motor.lever) == (12.0, 24.0, 18.8, 0.625)
    assert motor.armature == pytest.approx(0.034)
    assert limited(99.0, 0.0) == (24.0, 0.0)
    assert limited(0.0, -99.0) == (0.0, -15.0)
    assert limited(-99.0, 0.0, pitch_speed=-18.8) == pytest.approx((0.0, 0.0))
    assert limited(0.0, 99.0, roll_speed=18.8 / 0.625) == pytest.approx((0.0, 0.0))
    assert limited(99.0, 0.0, pitch_speed=0.75 * 18.8) == pytest.approx((12.0, 0.0))  # a quarter of the stall torque


def test_torques_within_the_diamond_pass_and_those_beyond_come_to_its_edge() -> None:
    pitch, roll = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 1000)) * np.array([[24.0], [15.0]])
    inside = np.abs(pitch) / 24.0 + np.abs(roll) / 15.0 <= 1.0
    given = ankles.within_limits((pitch, roll), (0.0 * pitch, 0.0 * roll), np.ones(1000))
    assert 0.4 < inside.mean() < 0.6
    for before, after in zip((pitch, roll), given, strict=True):
        np.testing.assert_allclose(after[inside], before[inside], atol=1e-12)
    edge = np.abs(given[0]) / 24.0 + np.abs(given[1]) / 15.0
    np.testing.assert_allclose(edge[~inside], 1.0)


@pytest.mark.parametrize("levers", [(1.0, 1.0), (1.2, 0.8)])
def test_the_inertia_is_that_of_two_motors(levers: tuple[float, float]) -> None:
    config = load_train_config(["robot=t1"])
    models = []
    for coupled in (False, True):
        spec = describe_scene(config.robot, config.engine, config.ball.table)
        if coupled:
            ankles.couple(spec, levers)
        models.append(compile_scene(spec, config.robot))
    masses = []
    for model in models:
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        for row, unit in zip(full, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, row, unit)
        masses.append(full)
    change = masses[1] - masses[0]
    a, b = 0.625 * levers[0], 0.625 * levers[1]
    expected = 0.034 * np.array([[2.0, a - b], [a - b, a * a + b * b]]) - 0.068 * np.eye(2)
    for columns in ankles.ankle_columns(config.robot):
        block = np.ix_(6 + columns, 6 + columns)
        np.testing.assert_allclose(change[block], expected, atol=1e-12)
        change[block] = 0.0
    np.testing.assert_allclose(change, 0.0, atol=1e-12)


def test_the_engine_keeps_the_motors_within_their_limits(tmp_path: Path) -> None:
    """And gives the same as the native engine while they are."""
    policy = load_policy(save_run(tmp_path))
    envs = [ankles.make_env(policy, ankles.Ankles(limited), 3) for limited in (False, True)]
    columns = ankles.ankle_columns(envs[0].config.robot)
    assert [[JOINT_NAMES[i] for i in row] for row in columns] == [
        [f"{side}_Ankle_{axis}" for axis in ("Pitch", "Roll")] for side in ("Left", "Right")
    ]
    engines = [env.worlds.engine for env in envs]
    qpos = torch.as_tensor(envs[0].worlds.model.key_qpos, dtype=torch.float32).repeat(3, 1)
    qpos[:, 2] += 1.0
    targets = qpos[:, None, 7:].repeat(1, engines[0].substeps, 1)
    targets[1, :, columns.ravel()] += 0.1
    targets[2, :, columns.ravel()] += torch.tensor([1.0, 1.0, -1.0, 1.0])
    for engine in engines:
        engine.params.effort_scale[2] = 0.5
        engine.apply_params(torch.ones(3, dtype=torch.bool))
        engine.reset(torch.ones(3, dtype=torch.bool), qpos, torch.zeros(3, 27))
        engine.advance(targets, torch.zeros(3, 27))
    torch.testing.assert_close(engines[1].qvel_path[:2], engines[0].qvel_path[:2], atol=1e-4, rtol=0.0)
    assert (engines[1].qvel_path[2] - engines[0].qvel_path[2]).abs().max() > 0.1
    shares = [engine.joint_torque[2, torch.as_tensor(columns)] / torch.tensor([12.0, 7.5]) for engine in engines]
    assert shares[0].abs().sum(1).max() > 1.05
    assert shares[1].abs().sum(1).max() < 1.001


def test_the_study_counts_serves_and_shares_of_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cases = {name: ankles.CASES[name] for name in ("as configured", "limits of the motors")}
    monkeypatch.setattr(ankles, "CASES", cases)
    found = ankles.compare(load_policy(save_run(tmp_path)), 2, 2)
    assert [one.row["serves"] for one in found] == [2, 2]
    assert found[1].torque == 0.0
    assert all(0.0 <= share <= 1.0 for one in found for share in (one.torque, one.speed))
    assert ankles.table(found).count("\n") == 1 + len(found)
