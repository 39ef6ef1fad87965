"""Both engines against MuJoCo itself, against each other and against their contract."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from pace.config.base import ConfigError
from pace.config.training import load_train_config
from pace.devices import resolve_device
from pace.sim.engine.base import EngineParams
from pace.sim.engine.factory import make_engine
from pace.sim.engine.native import NativeEngine
from pace.sim.robot import build_model, nominal_pose
from tests.helpers.robot import CONTACT_BODIES, JOINT_NAMES

WORLDS = 4
CONFIG = load_train_config()
NOMINAL = torch.as_tensor(nominal_pose(CONFIG.robot), dtype=torch.float32)
STILL = torch.zeros(WORLDS, 27)
EVERY = torch.ones(WORLDS, dtype=torch.bool)
ENGINES = ("native", "mjwarp")
MASS = 31.9052


def build(name, physics_dt=0.01, control_dt=0.02, **engine_options):
    """An engine of WORLDS worlds, and its model."""
    engine = dataclasses.replace(CONFIG.engine, name=name, physics_dt=physics_dt, **engine_options)
    model = build_model(CONFIG.robot, engine, CONFIG.ball.table)
    return make_engine(model, engine, WORLDS, "cpu", round(control_dt / physics_dt)), model


def standing(model, lift=0.0):
    qpos = torch.as_tensor(model.key_qpos[0], dtype=torch.float32).repeat(WORLDS, 1)
    qpos[:, 2] += lift
    return qpos


def random_targets(engine, generator, scale=0.25):
    targets = NOMINAL + scale * torch.randn(WORLDS, 1, len(JOINT_NAMES), generator=generator)
    return targets.repeat(1, engine.substeps, 1)


def hold(engine):
    return NOMINAL.repeat(WORLDS, engine.substeps, 1)


@pytest.fixture(scope="module", params=ENGINES)
def shared(request):
    """One engine of each kind at 10 ms for the tests that put back what they change."""
    return build(request.param)


@pytest.fixture
def fresh(shared):
    """The shared engine, standing, with nominal parameters."""
    engine, model = shared
    nominal = EngineParams.nominal(model, WORLDS, engine.device)
    for field in dataclasses.fields(EngineParams):
        getattr(engine.params, field.name).copy_(getattr(nominal, field.name))
    engine.apply_params(EVERY)
    engine.reset(EVERY, standing(model), STILL)
    return engine, model


@pytest.mark.parametrize("physics_dt", [0.002, 0.01])
def test_engines_agree_over_the_same_random_targets(physics_dt):
    """Float32 against float64, and solver tolerances of 1e-6 and 1e-8, differ by 1e-4 rad/s over 0.2 s.

    Later a contact that one engine makes a step earlier sets them apart: motion on a rigid floor is chaotic.
    """
    (native, model), (warp, _) = (build(name, physics_dt) for name in ENGINES)
    generator = torch.Generator().manual_seed(5)
    for engine in (native, warp):
        engine.params.friction.copy_(torch.tensor([0.5, 0.7, 0.9, 1.0]))
        engine.params.trunk_mass.copy_(torch.tensor([-2.0, 0.0, 1.0, 2.0]))
        engine.params.kp_scale.copy_(torch.tensor([0.9, 1.0, 1.1, 1.2]))
        engine.apply_params(EVERY)
        engine.reset(EVERY, standing(model), STILL)
    for _ in range(10):
        targets, applied = random_targets(native, generator), torch.randn(WORLDS, 27, generator=generator)
        for engine in (native, warp):
            engine.advance(targets, applied)
        torch.testing.assert_close(warp.qpos_path, native.qpos_path, atol=1e-4, rtol=0)
        torch.testing.assert_close(warp.qvel_path, native.qvel_path, atol=1e-2, rtol=0)
        torch.testing.assert_close(warp.foot_force, native.foot_force, atol=1.0, rtol=1e-2)
        torch.testing.assert_close(warp.joint_torque, native.joint_torque, atol=0.05, rtol=0)
        torch.testing.assert_close(warp.body_contact, native.body_contact)
    assert native.foot_force[..., 2].max() > 100.0  # the robots did stand and step


def test_native_is_mj_step_bit_by_bit():
    engine, model = build("native", physics_dt=0.004)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    generator = torch.Generator().manual_seed(2)
    engine.load_state_dict(engine.state_dict() | {"qpos": torch.as_tensor(model.key_qpos).repeat(WORLDS, 1)})
    for _ in range(5):
        targets, applied = random_targets(engine, generator), torch.randn(WORLDS, 27, generator=generator)
        engine.advance(targets, applied)
        data.qfrc_applied[:] = applied[1].numpy()
        for step in range(engine.substeps):
            data.ctrl[:] = targets[1, step].numpy()
            mujoco.mj_step(model, data)
            np.testing.assert_array_equal(engine.qpos_path[1, step + 1], data.qpos.astype(np.float32))
            np.testing.assert_array_equal(engine.qvel_path[1, step + 1], data.qvel.astype(np.float32))
        np.testing.assert_array_equal(engine.joint_torque[1], data.actuator_force.astype(np.float32))


def test_native_stops_mujocos_timers():
    _, model = build("native")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert all(timer.duration == 0.0 for timer in data.timer)
    assert data.timer[mujoco.mjtTimer.mjTIMER_STEP].number == 1


def test_path_begins_where_the_last_one_ended_plus_the_push(fresh):
    engine, _ = fresh
    engine.advance(hold(engine), STILL)
    end_qpos, end_qvel = engine.qpos_path[:, -1].clone(), engine.qvel_path[:, -1].clone()
    push = torch.zeros(WORLDS, 27)
    push[1, 0], push[2, 1] = 0.3, -0.2
    engine.add_velocity(push)
    engine.advance(hold(engine), STILL)
    torch.testing.assert_close(engine.qpos_path[:, 0], end_qpos)
    torch.testing.assert_close(engine.qvel_path[:, 0], end_qvel + push)


def test_tensors_are_the_same_objects_for_ever(fresh):
    engine, model = fresh
    names = ("qpos_path", "qvel_path", "foot_force", "body_contact", "joint_torque")
    before = [getattr(engine, name).data_ptr() for name in names]
    shapes = [tuple(getattr(engine, name).shape) for name in names]
    engine.advance(hold(engine), STILL)
    engine.reset(EVERY, standing(model), STILL)
    assert [getattr(engine, name).data_ptr() for name in names] == before
    assert shapes == [(WORLDS, 3, 28), (WORLDS, 3, 27), (WORLDS, 2, 3), (WORLDS, len(CONTACT_BODIES)), (WORLDS, 21)]


def test_reset_touches_the_masked_worlds_alone(fresh):
    engine, model = fresh
    generator = torch.Generator().manual_seed(8)
    for _ in range(3):
        engine.advance(random_targets(engine, generator), STILL)
    before = {name: value.clone() for name, value in engine.state_dict().items()}
    mask = torch.tensor([False, True, False, True])
    qpos, qvel = standing(model, lift=0.5), 0.1 * torch.ones(WORLDS, 27)
    engine.reset(mask, qpos, qvel)
    for name, value in engine.state_dict().items():
        torch.testing.assert_close(value[~mask], before[name][~mask], rtol=0, atol=0)
    torch.testing.assert_close(engine.qpos_path[mask], qpos[mask].unsqueeze(1).expand(-1, 3, -1))
    torch.testing.assert_close(engine.qvel_path[mask], qvel[mask].unsqueeze(1).expand(-1, 3, -1))
    for value in (engine.foot_force, engine.body_contact, engine.joint_torque, engine.state_dict()["warmstart"]):
        assert not value[mask].any()


def test_a_reset_world_forgets_its_past_even_a_nan(fresh):
    engine, model = fresh
    engine.advance(hold(engine), STILL)
    expected = engine.qvel_path[0].clone()
    broken = torch.zeros(WORLDS, 27)
    broken[2] = torch.nan
    engine.add_velocity(broken)
    engine.advance(hold(engine), STILL)
    assert not engine.qvel_path[2, -1].isfinite().all()  # seen, not healed in silence
    assert engine.qvel_path[[0, 1, 3]].isfinite().all()
    engine.reset(EVERY, standing(model), STILL)
    engine.advance(hold(engine), STILL)
    torch.testing.assert_close(engine.qvel_path[2], expected, rtol=0, atol=1e-5)


def test_state_dict_continues_exactly(fresh):
    engine, _ = fresh
    generator = torch.Generator().manual_seed(4)
    targets = [random_targets(engine, generator) for _ in range(6)]
    for target in targets[:3]:
        engine.advance(target, STILL)
    saved = {name: value.clone() for name, value in engine.state_dict().items()}
    ends = []
    for _ in range(2):
        for target in targets[3:]:
            engine.advance(target, STILL)
        ends.append(engine.qpos_path.clone())
        engine.load_state_dict(saved)
    torch.testing.assert_close(ends[0], ends[1], rtol=0, atol=0)


#: parameter -> (its value in world 1, the same change made to MuJoCo's model by hand)
def _friction(model):
    model.pair_friction[:, :2] = 0.3


def _trunk_mass(model):
    model.body("Trunk").inertia[:] *= (11.7 + 3.0) / 11.7
    model.body("Trunk").mass[0] += 3.0


def _trunk_com(model):
    model.body("Trunk").ipos[:] += [0.05, -0.03, 0.02]


def _kp(model):
    model.actuator_gainprm[:, 4] *= 1.3


def _kd(model):
    model.actuator_gainprm[:, 6] *= 0.6


def _armature(model):
    model.dof_armature[6:] *= 2.5


def _effort(model):
    model.actuator_forcerange *= 0.2
    model.actuator_gainprm[:, 0] /= 0.2  # the resistance: the stall torque too


def _speed(model):
    model.actuator_gainprm[:, 7] *= 0.1  # the largest voltage, with a constant of 1 the no-load speed
    model.actuator_gainprm[:, 0] *= 0.1  # the resistance: the same stall torque


def _ankles(model):
    ankles = [index for index, name in enumerate(JOINT_NAMES) if "Ankle" in name]
    model.actuator_forcerange[ankles] *= 0.1
    model.actuator_gainprm[ankles, 0] /= 0.1


def _joint_friction(model):
    model.dof_frictionloss[6:] += 1.5


def _joint_damping(model):
    model.dof_damping[6:] += 2.0


CHANGES = {
    "friction": (0.3, _friction),
    "trunk_mass": (3.0, _trunk_mass),
    "trunk_com": (torch.tensor([0.05, -0.03, 0.02]), _trunk_com),
    "kp_scale": (1.3, _kp),
    "kd_scale": (0.6, _kd),
    "armature_scale": (2.5, _armature),
    "effort_scale": (0.2, _effort),
    "speed_scale": (0.1, _speed),
    "ankle_effort_scale": (0.1, _ankles),
    "joint_friction": (1.5, _joint_friction),
    "joint_damping": (2.0, _joint_damping),
}


def play(engine, model):
    """Four control steps of the same targets and a sidewards shove in every world."""
    engine.reset(EVERY, standing(model), STILL)
    generator = torch.Generator().manual_seed(6)
    targets = (NOMINAL + 0.3 * torch.randn(4, 1, 1, 21, generator=generator)).expand(-1, WORLDS, engine.substeps, -1)
    shove = torch.zeros(WORLDS, 27)
    shove[:, 1] = 150.0
    for target in targets:
        engine.advance(target, shove)
    return engine.qvel_path.clone(), [t[0].numpy() for t in targets], shove[0].numpy()


@pytest.mark.parametrize("name", CHANGES)
def test_a_parameter_changes_its_world_alone_and_as_in_mujoco(fresh, name):
    engine, model = fresh
    assert {field.name for field in dataclasses.fields(EngineParams)} == set(CHANGES)
    untouched, _, _ = play(engine, model)
    value, by_hand = CHANGES[name]
    getattr(engine.params, name)[:] = value  # the mask, not the values, says which worlds take part
    engine.apply_params(torch.tensor([False, True, False, False]))
    changed, targets, shove = play(engine, model)
    others = [0, 2, 3]
    torch.testing.assert_close(changed[others], untouched[others], rtol=0, atol=0)
    assert (changed[1] - untouched[1]).abs().max() > 1e-2

    reference = build_model(CONFIG.robot, CONFIG.engine, CONFIG.ball.table)
    by_hand(reference)
    np.testing.assert_allclose(changed[1, -1], mujocos(reference, targets, shove), atol=5e-3)


def mujocos(model, targets, shove):
    """Velocities (27,) that MuJoCo computes for the motion of :func:`play`."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for target in targets:
        for step in target:
            data.ctrl[:], data.qfrc_applied[:] = step, shove
            mujoco.mj_step(model, data)
    return data.qvel


@pytest.mark.parametrize("name", ENGINES)
def test_joints_without_friction_can_have_some(name):
    """The engines set a row of the solver aside for each joint with friction."""
    config = load_train_config(["robot=t1_paper", f"engine={name}", "engine.threads=1"])
    reference = build_model(config.robot, config.engine, config.ball.table)
    assert not reference.dof_frictionloss.any()
    engine = make_engine(reference, config.engine, WORLDS, "cpu", 2)
    engine.params.joint_friction[1] = 1.5
    engine.apply_params(EVERY)
    velocities, targets, shove = play(engine, reference)
    np.testing.assert_allclose(velocities[0, -1], mujocos(reference, targets, shove), atol=5e-3)
    _joint_friction(reference)
    np.testing.assert_allclose(velocities[1, -1], mujocos(reference, targets, shove), atol=5e-3)
    assert (velocities[1] - velocities[0]).abs().max() > 1e-2


def test_parameters_can_be_taken_back(fresh):
    engine, model = fresh
    untouched, _, _ = play(engine, model)
    for name, (value, _) in CHANGES.items():
        getattr(engine.params, name)[:] = value
    engine.apply_params(EVERY)
    nominal = EngineParams.nominal(model, WORLDS, engine.device)
    for name in CHANGES:
        getattr(engine.params, name).copy_(getattr(nominal, name))
    engine.apply_params(EVERY)
    torch.testing.assert_close(play(engine, model)[0], untouched, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ENGINES)
def test_foot_forces_carry_weight_and_change_of_momentum(name):
    """Sum of vertical force x dt = m (g T + change of the centre of mass's velocity), every physics step counted."""
    engine, model = build(name, physics_dt=0.01, control_dt=0.01)
    engine.reset(EVERY, standing(model), STILL)
    impulse, steps = torch.zeros(WORLDS), 25
    for _ in range(steps):
        engine.advance(hold(engine), STILL)
        impulse += engine.foot_force[..., 2].sum(1) * engine.physics_dt
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = engine.qpos_path[0, -1].numpy(), engine.qvel_path[0, -1].numpy()
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    expected = MASS * (9.81 * steps * engine.physics_dt + data.subtree_linvel[1, 2])
    np.testing.assert_allclose(impulse, expected, rtol=0.01)
    assert (engine.foot_force[..., 2] > 0).all()
    assert not engine.body_contact.any()


def test_no_force_in_the_air(fresh):
    engine, model = fresh
    engine.reset(EVERY, standing(model, lift=0.3), STILL)
    engine.advance(hold(engine), STILL)
    assert not engine.foot_force.any()
    np.testing.assert_allclose(engine.qvel_path[:, -1, 2], -9.81 * 0.02, atol=2e-3)  # legs swing a little


def test_a_fall_is_seen_in_the_body_contacts(fresh):
    engine, model = fresh
    lying = standing(model)
    lying[0, 2], lying[0, 3:7] = 0.25, torch.tensor([0.7071068, 0, 0.7071068, 0])  # face down
    engine.reset(EVERY, lying, STILL)
    for _ in range(15):
        engine.advance(hold(engine), STILL)
    touching = {body for body, touched in zip(CONTACT_BODIES, engine.body_contact[0], strict=True) if touched}
    assert "trunk" in touching or "head" in touching
    assert set(engine.body_contact.unique().tolist()) == {0.0, 1.0}
    assert engine.qpos_path[0, -1, 2] > 0.02  # it lies on the floor, not in it


def test_paddle_in_the_table_is_seen(fresh):
    engine, model = fresh
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    at = standing(model)
    shift = torch.tensor([-1.3, 0.0, 0.76]) - torch.tensor(data.site("paddle").xpos, dtype=torch.float32)
    at[3, :3] += shift
    engine.reset(EVERY, at, STILL)
    engine.advance(hold(engine), STILL)
    assert engine.body_contact[3, CONTACT_BODIES.index("paddle")] == 1.0
    assert not engine.body_contact[:3].any()


def beside_the_table(model):
    """Standing away from it; left forearm, held forwards, 2 mm in its top; thighs 2 mm in its end; paddle in it."""
    data, at = mujoco.MjData(model), standing(model)
    at[1, 7 + JOINT_NAMES.index("Left_Shoulder_Pitch")] = -0.8
    at[1, 7 + JOINT_NAMES.index("Right_Shoulder_Pitch")] = -2.5  # the paddle held high
    for world, name, place in ((1, "left_forearm", [-1.25, 0.2, 0.758]), (3, "paddle", [-1.3, 0.2, 0.758])):
        put_lowest(model, data, at[world], name, np.array(place))
    data.qpos[:] = at[2]
    mujoco.mj_kinematics(model, data)
    front = np.array([-1.368 - model.geom("left_thigh").size[0], 0.2, 0.745])
    at[2, :3] += torch.tensor(front - data.geom("left_thigh").xpos, dtype=torch.float32)
    return at


def put_lowest(model, data, qpos, name, place):
    """Move a robot so that the lowest point of a capsule, or about that of a cylinder, is at ``place``."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    steep, size = abs(data.geom(name).xmat[8]), model.geom(name).size
    depth = size[1] * steep + size[0] * (np.sqrt(1 - steep**2) if name == "paddle" else 1.0)
    lift = np.array([0.0, 0.0, depth])
    qpos[:3] += torch.tensor(place + lift - data.geom(name).xpos, dtype=torch.float32)


def forces_on_the_robot(model, data):
    """Sums (2, 3) N of MuJoCo's contact forces between table and robot, and table and left forearm."""
    table, forearm, sums = model.geom("table").id, model.geom("left_forearm").id, np.zeros((2, 3))
    for index, contact in enumerate(data.contact[: data.ncon]):
        if table in contact.geom:
            wrench = np.zeros(6)
            mujoco.mj_contactForce(model, data, index, wrench)
            force = contact.frame.reshape(3, 3).T @ wrench[:3] * (1.0 if contact.geom[0] == table else -1.0)
            sums += np.array([force, force * (forearm in contact.geom)])
    return sums


def test_forces_on_the_table_are_mujocos_contact_forces(fresh):
    engine, model = fresh
    at = beside_the_table(model)
    engine.reset(EVERY, at, STILL)
    engine.advance(hold(engine), STILL)
    assert engine.table_force.shape == (WORLDS, 2, 2, 3)
    for world in range(WORLDS):
        data = mujoco.MjData(model)
        data.qpos[:], data.ctrl[:] = at[world], NOMINAL
        for step in range(2):
            mujoco.mj_step(model, data)
            found, expected = engine.table_force[world, step], forces_on_the_robot(model, data)
            np.testing.assert_allclose(found, expected, atol=0.02 * np.abs(expected).max() + 1e-6)
    whole, hand = engine.table_force[:, 0].unbind(1)
    assert not whole[0].any()
    assert not hand[[0, 2, 3]].any()
    assert torch.equal(whole[1], hand[1])
    assert hand[1, 2] > hand[1, :2].norm()  # N, upwards from the top
    assert whole[2, 0] < -whole[2, 1:].norm()  # away from its end
    assert whole[3, 2] > whole[3, :2].norm()


def test_applied_force_moves_the_base(fresh):
    engine, model = fresh
    engine.reset(EVERY, standing(model, lift=1.0), STILL)
    applied = torch.zeros(WORLDS, 27)
    applied[1, 0] = MASS  # 1 m/s^2 on the centre of mass, less what the swinging joints take
    engine.advance(hold(engine), applied)
    gained = engine.qvel_path[1, -1, :3] - engine.qvel_path[0, -1, :3]
    data = mujoco.MjData(model)
    velocities = []
    for world in (0, 1):
        data.qpos[:], data.qvel[:] = engine.qpos_path[world, -1].numpy(), engine.qvel_path[world, -1].numpy()
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        velocities.append(data.subtree_linvel[1].copy())
    np.testing.assert_allclose(velocities[1] - velocities[0], [0.02, 0, 0], atol=2e-4)
    assert gained[0] > 0.01


def test_overflow_is_seen():
    roomy, _ = build("mjwarp")
    cramped, _ = build("mjwarp", contacts_per_world=2, constraints_per_world=8)
    for engine in (roomy, cramped):
        engine.advance(hold(engine), STILL)
    assert not roomy.overflowed()
    assert cramped.overflowed()


def test_auto_is_native_on_the_cpu():
    engine, _ = build("auto")
    assert isinstance(engine, NativeEngine)
    assert engine.device == torch.device("cpu")


def test_wrong_devices_and_sizes_are_config_errors():
    model = build_model(CONFIG.robot, CONFIG.engine, CONFIG.ball.table)
    with pytest.raises(ConfigError, match="native runs on the CPU"):
        NativeEngine(model, CONFIG.engine, 1, torch.device("cuda"), 2)
    with pytest.raises(ConfigError, match="num_worlds must be at least 1, got 0"):
        make_engine(model, CONFIG.engine, 0, "cpu", 2)
    with pytest.raises(ConfigError, match="substeps must be at least 1"):
        make_engine(model, CONFIG.engine, 1, "cpu", 0)
    for unknown in ("gpu", "xpu", "cuda:x"):
        with pytest.raises(ConfigError, match="device must be auto, cpu, cuda"):
            resolve_device(unknown)
    with pytest.raises(ConfigError, match=r"cuda:99 is not there.*device=cpu"):
        resolve_device("cuda:99")
