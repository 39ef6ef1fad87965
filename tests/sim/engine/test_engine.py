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
from pace.sim.engine.mjwarp import MjwarpEngine
from pace.sim.engine.native import NativeEngine
from pace.sim.robot import build_model
from pace.sim.robot_spec import RobotSpec

WORLDS = 4
CONFIGS = {name: load_train_config([f"robot={name}"]) for name in ("t1", "t1_29dof")}
CONFIG = CONFIGS["t1"]
EVERY = torch.ones(WORLDS, dtype=torch.bool)
ENGINES = ("native", "mjwarp")
#: kg: the maker's sum for the T1 with its paddle; that of the 29-joint T1, and a paddle of 0.17
MASS = {"t1": 31.9052, "t1_29dof": 34.6325 + 0.17}
#: Engine and robot; make test compares t1_29dof on mjwarp with native once, make test-long asks it everything.
PAIRS = [
    ("native", "t1"),
    ("mjwarp", "t1"),
    ("native", "t1_29dof"),
    pytest.param(("mjwarp", "t1_29dof"), marks=pytest.mark.long),
]


def build(name, physics_dt=0.01, control_dt=0.02, robot="t1", **engine_options):
    """An engine of WORLDS worlds, and its model."""
    config = CONFIGS[robot]
    engine = dataclasses.replace(config.engine, name=name, physics_dt=physics_dt, **engine_options)
    model = build_model(config.robot, engine, config.ball.table)
    return make_engine(model, engine, WORLDS, "cpu", round(control_dt / physics_dt)), model


def standing(model, lift=0.0):
    qpos = torch.as_tensor(model.key_qpos[0], dtype=torch.float32).repeat(WORLDS, 1)
    qpos[:, 2] += lift
    return qpos


def still(model):
    return torch.zeros(WORLDS, model.nv)


def random_targets(engine, model, generator, scale=0.25):
    targets = standing(model)[:, None, 7:] + scale * torch.randn(WORLDS, 1, model.nu, generator=generator)
    return targets.repeat(1, engine.substeps, 1)


def hold(engine, model):
    return standing(model)[:, None, 7:].repeat(1, engine.substeps, 1)


def joints(model):
    return [model.actuator(index).name for index in range(model.nu)]


def contact_bodies(model):
    """Names of the columns of ``body_contact``."""
    return next(
        spec.contacts for config in CONFIGS.values() if len((spec := RobotSpec.of(config.robot)).joints) == model.nu
    )


@pytest.fixture(scope="module", params=PAIRS, ids="-".join)
def pair(request):
    return request.param


@pytest.fixture(scope="module")
def robot(pair):
    return pair[1]


@pytest.fixture(scope="module")
def shared(pair):
    """One engine of each kind at 10 ms for the tests that put back what they change."""
    name, robot = pair
    return build(name, robot=robot)


@pytest.fixture
def fresh(shared):
    """The shared engine, standing, with nominal parameters."""
    engine, model = shared
    nominal = EngineParams.nominal(model, WORLDS, engine.device)
    for field in dataclasses.fields(EngineParams):
        getattr(engine.params, field.name).copy_(getattr(nominal, field.name))
    engine.apply_params(EVERY)
    engine.reset(EVERY, standing(model), still(model))
    return engine, model


@pytest.mark.parametrize(
    ("physics_dt", "robot"),
    [(0.002, "t1"), (0.01, "t1"), pytest.param(0.01, "t1_29dof", marks=pytest.mark.slow)],
)
def test_engines_agree_over_the_same_random_targets(physics_dt, robot):
    """Float32 against float64, and solver tolerances of 1e-6 and 1e-8, differ by 1e-4 rad/s over 0.2 s.

    Later a contact that one engine makes a step earlier sets them apart: motion on a rigid floor is chaotic.
    """
    (native, model), (warp, _) = (build(name, physics_dt, robot=robot) for name in ENGINES)
    generator = torch.Generator().manual_seed(5)
    for engine in (native, warp):
        engine.params.friction.copy_(torch.tensor([0.5, 0.7, 0.9, 1.0]))
        engine.params.trunk_mass.copy_(torch.tensor([-2.0, 0.0, 1.0, 2.0]))
        engine.params.kp_scale.copy_(torch.tensor([0.9, 1.0, 1.1, 1.2]))
        engine.apply_params(EVERY)
        engine.reset(EVERY, standing(model), still(model))
    for _ in range(10):
        targets, applied = random_targets(native, model, generator), torch.randn(WORLDS, model.nv, generator=generator)
        for engine in (native, warp):
            engine.advance(targets, applied)
        torch.testing.assert_close(warp.qpos_path, native.qpos_path, atol=1e-4, rtol=0)
        torch.testing.assert_close(warp.qvel_path, native.qvel_path, atol=1e-2, rtol=0)
        torch.testing.assert_close(warp.foot_force, native.foot_force, atol=1.0, rtol=1e-2)
        torch.testing.assert_close(warp.joint_torque, native.joint_torque, atol=0.05, rtol=0)
        torch.testing.assert_close(warp.body_contact, native.body_contact)
    assert native.foot_force[..., 2].max() > 100.0  # the robots did stand and step


@pytest.mark.parametrize("robot", CONFIGS)
def test_native_is_mj_step_bit_by_bit(robot):
    engine, model = build("native", physics_dt=0.004, robot=robot)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    generator = torch.Generator().manual_seed(2)
    engine.load_state_dict(engine.state_dict() | {"qpos": torch.as_tensor(model.key_qpos).repeat(WORLDS, 1)})
    for _ in range(5):
        targets, applied = random_targets(engine, model, generator), torch.randn(WORLDS, model.nv, generator=generator)
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
    engine, model = fresh
    engine.advance(hold(engine, model), still(model))
    end_qpos, end_qvel = engine.qpos_path[:, -1].clone(), engine.qvel_path[:, -1].clone()
    push = still(model)
    push[1, 0], push[2, 1] = 0.3, -0.2
    engine.add_velocity(push)
    engine.advance(hold(engine, model), still(model))
    torch.testing.assert_close(engine.qpos_path[:, 0], end_qpos)
    torch.testing.assert_close(engine.qvel_path[:, 0], end_qvel + push)


def test_tensors_are_the_same_objects_for_ever(fresh):
    engine, model = fresh
    names = ("qpos_path", "qvel_path", "foot_force", "body_contact", "joint_torque")
    before = [getattr(engine, name).data_ptr() for name in names]
    shapes = [tuple(getattr(engine, name).shape) for name in names]
    engine.advance(hold(engine, model), still(model))
    engine.reset(EVERY, standing(model), still(model))
    assert [getattr(engine, name).data_ptr() for name in names] == before
    sizes = (model.nq, model.nv, len(contact_bodies(model)), model.nu)
    assert sizes in [(28, 27, 11, 21), (34, 33, 13, 27)]
    positions, velocities, contacts, torques = sizes
    assert shapes == [
        (WORLDS, 3, positions),
        (WORLDS, 3, velocities),
        (WORLDS, 2, 3),
        (WORLDS, contacts),
        (WORLDS, torques),
    ]


def test_reset_touches_the_masked_worlds_alone(fresh):
    engine, model = fresh
    generator = torch.Generator().manual_seed(8)
    for _ in range(3):
        engine.advance(random_targets(engine, model, generator), still(model))
    before = {name: value.clone() for name, value in engine.state_dict().items()}
    mask = torch.tensor([False, True, False, True])
    qpos, qvel = standing(model, lift=0.5), torch.full((WORLDS, model.nv), 0.1)
    engine.reset(mask, qpos, qvel)
    for name, value in engine.state_dict().items():
        torch.testing.assert_close(value[~mask], before[name][~mask], rtol=0, atol=0)
    torch.testing.assert_close(engine.qpos_path[mask], qpos[mask].unsqueeze(1).expand(-1, 3, -1))
    torch.testing.assert_close(engine.qvel_path[mask], qvel[mask].unsqueeze(1).expand(-1, 3, -1))
    for value in (engine.foot_force, engine.body_contact, engine.joint_torque, engine.state_dict()["warmstart"]):
        assert not value[mask].any()


def test_a_reset_world_forgets_its_past_even_a_nan(fresh):
    engine, model = fresh
    engine.advance(hold(engine, model), still(model))
    expected = engine.qvel_path[0].clone()
    broken = still(model)
    broken[2] = torch.nan
    engine.add_velocity(broken)
    engine.advance(hold(engine, model), still(model))
    assert not engine.qvel_path[2, -1].isfinite().all()  # seen, not healed in silence
    assert engine.qvel_path[[0, 1, 3]].isfinite().all()
    engine.reset(EVERY, standing(model), still(model))
    engine.advance(hold(engine, model), still(model))
    torch.testing.assert_close(engine.qvel_path[2], expected, rtol=0, atol=1e-5)


def test_state_dict_continues_exactly(fresh):
    engine, model = fresh
    generator = torch.Generator().manual_seed(4)
    targets = [random_targets(engine, model, generator) for _ in range(6)]
    for target in targets[:3]:
        engine.advance(target, still(model))
    saved = {name: value.clone() for name, value in engine.state_dict().items()}
    ends = []
    for _ in range(2):
        for target in targets[3:]:
            engine.advance(target, still(model))
        ends.append(engine.qpos_path.clone())
        engine.load_state_dict(saved)
    torch.testing.assert_close(ends[0], ends[1], rtol=0, atol=0)


#: parameter -> (its value in world 1, the same change made to MuJoCo's model by hand)
def _friction(model):
    model.pair_friction[:, :2] = 0.3


def _trunk_mass(model):
    trunk = model.body("Trunk")
    trunk.inertia[:] *= (trunk.mass[0] + 3.0) / trunk.mass[0]
    trunk.mass[0] += 3.0


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
    ankles = [index for index, name in enumerate(joints(model)) if "Ankle" in name]
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
    engine.reset(EVERY, standing(model), still(model))
    generator = torch.Generator().manual_seed(6)
    nominal = standing(model)[0, 7:]
    targets = nominal + 0.3 * torch.randn(4, 1, 1, model.nu, generator=generator)
    targets = targets.expand(-1, WORLDS, engine.substeps, -1)
    shove = still(model)
    shove[:, 1] = 150.0
    for target in targets:
        engine.advance(target, shove)
    return engine.qvel_path.clone(), [t[0].numpy() for t in targets], shove[0].numpy()


@pytest.mark.parametrize("name", CHANGES)
def test_a_parameter_changes_its_world_alone_and_as_in_mujoco(fresh, robot, name):
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

    config = CONFIGS[robot]
    reference = build_model(config.robot, config.engine, config.ball.table)
    by_hand(reference)
    np.testing.assert_allclose(changed[1, -1], mujocos(reference, targets, shove), atol=5e-3)


def mujocos(model, targets, shove):
    """Velocities (nv,) that MuJoCo computes for the motion of :func:`play`."""
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


def test_foot_forces_carry_weight_and_change_of_momentum(pair):
    """Sum of vertical force x dt = m (g T + change of the centre of mass's velocity), every physics step counted."""
    name, robot = pair
    engine, model = build(name, physics_dt=0.01, control_dt=0.01, robot=robot)
    engine.reset(EVERY, standing(model), still(model))
    impulse, steps = torch.zeros(WORLDS), 25
    for _ in range(steps):
        engine.advance(hold(engine, model), still(model))
        impulse += engine.foot_force[..., 2].sum(1) * engine.physics_dt
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = engine.qpos_path[0, -1].numpy(), engine.qvel_path[0, -1].numpy()
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    expected = MASS[robot] * (9.81 * steps * engine.physics_dt + data.subtree_linvel[1, 2])
    np.testing.assert_allclose(impulse, expected, rtol=0.01)
    assert (engine.foot_force[..., 2] > 0).all()
    assert not engine.body_contact.any()


def test_no_force_in_the_air(fresh):
    engine, model = fresh
    engine.reset(EVERY, standing(model, lift=0.3), still(model))
    engine.advance(hold(engine, model), still(model))
    assert not engine.foot_force.any()
    np.testing.assert_allclose(engine.qvel_path[:, -1, 2], -9.81 * 0.02, atol=2e-3)  # legs swing a little


def test_a_fall_is_seen_in_the_body_contacts(fresh):
    engine, model = fresh
    lying = standing(model)
    lying[0, 2], lying[0, 3:7] = 0.25, torch.tensor([0.7071068, 0, 0.7071068, 0])  # face down
    engine.reset(EVERY, lying, still(model))
    for _ in range(15):
        engine.advance(hold(engine, model), still(model))
    touching = {body for body, touched in zip(contact_bodies(model), engine.body_contact[0], strict=True) if touched}
    assert "trunk" in touching or "head" in touching
    assert set(engine.body_contact.unique().tolist()) == {0.0, 1.0}
    assert engine.qpos_path[0, -1, 2] > 0.02  # it lies on the floor, not in it


def test_a_trunk_that_falls_on_the_table_moves_alike_on_both_engines():
    """Box on box, by the same test for boxes: MuJoCo Warp's general algorithm finds other points, and is 3 mrad off."""
    yaw, pitch = torch.tensor([[0.3, 0.9, 1.7, 2.6], [1.5, 1.7, 1.35, 1.9]])  # face down
    turns = [((0.5 * angle).cos(), (0.5 * angle).sin()) for angle in (yaw, pitch)]
    (cos_yaw, sin_yaw), (cos_pitch, sin_pitch) = turns
    lying_down = torch.stack([cos_yaw * cos_pitch, -sin_yaw * sin_pitch, cos_yaw * sin_pitch, sin_yaw * cos_pitch], 1)
    seen = []
    for name in ("native", "mjwarp"):
        engine, model = build(name)
        start = standing(model)
        start[:, 0], start[:, 1] = torch.tensor([[-1.0, -0.9, -0.8, -0.7], [0.0, 0.1, 0.3, 0.5]])
        start[:, 2], start[:, 3:7] = 1.22, lying_down
        engine.reset(EVERY, start, still(model))
        touched = torch.zeros(WORLDS)
        for _ in range(25):
            engine.advance(hold(engine, model), still(model))
            touched = touched.maximum(engine.body_contact[:, contact_bodies(model).index("trunk")])
        assert touched.all()
        seen.append(engine.qpos_path[:, -1].clone())
    torch.testing.assert_close(seen[0], seen[1], rtol=0, atol=5e-5)


def test_a_fixed_order_of_the_sums_changes_nothing_on_a_cpu():
    """``engine.deterministic``: a CPU has a fixed order anyway."""
    seen = []
    for fixed in (False, True):
        engine, model = build("mjwarp", deterministic=fixed)
        generator = torch.Generator().manual_seed(6)
        for _ in range(8):
            engine.advance(random_targets(engine, model, generator), still(model))
        assert isinstance(engine, MjwarpEngine)
        assert (engine.model.opt.deterministic != 0) is fixed
        seen.append(engine.qpos_path.clone())
    assert torch.equal(*seen)


def test_paddle_in_the_table_is_seen(fresh):
    engine, model = fresh
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    at = standing(model)
    shift = torch.tensor([-1.3, 0.0, 0.76]) - torch.tensor(data.site("paddle").xpos, dtype=torch.float32)
    at[3, :3] += shift
    engine.reset(EVERY, at, still(model))
    engine.advance(hold(engine, model), still(model))
    assert engine.body_contact[3, contact_bodies(model).index("paddle")] == 1.0
    assert not engine.body_contact[:3].any()


def beside_the_table(model):
    """Standing away from it; left forearm or hand, held forwards, 2 mm in its top; thighs 2 mm in its end; paddle in
    it."""
    data, at, joint = mujoco.MjData(model), standing(model), joints(model).index
    at[1, 7 + joint("Left_Shoulder_Pitch")] = -0.8
    at[1, 7 + joint("Right_Shoulder_Pitch")] = -2.5  # the paddle held high
    at[2, 7 + joint("Left_Shoulder_Pitch")] = 1.0  # backwards, away from the table
    for world, name, place in ((1, free_hand(model)[-1], [-1.25, 0.2, 0.758]), (3, "paddle", [-1.3, 0.2, 0.758])):
        put_lowest(model, data, at[world], name, np.array(place))
    data.qpos[:] = at[2]
    mujoco.mj_kinematics(model, data)
    front = np.array([-1.368 - model.geom("left_thigh").size[0], 0.2, 0.745])
    at[2, :3] += torch.tensor(front - data.geom("left_thigh").xpos, dtype=torch.float32)
    return at


def free_hand(model):
    """Geoms of the left arm that must not touch the table."""
    return [name for name in ("left_forearm", "left_hand") if name in contact_bodies(model)]


def put_lowest(model, data, qpos, name, place):
    """Move a robot so that the lowest point of a capsule, or about that of a cylinder, is at ``place``."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    steep, size = abs(data.geom(name).xmat[8]), model.geom(name).size
    depth = size[1] * steep + size[0] * (np.sqrt(1 - steep**2) if name == "paddle" else 1.0)
    lift = np.array([0.0, 0.0, depth])
    qpos[:3] += torch.tensor(place + lift - data.geom(name).xpos, dtype=torch.float32)


def forces_on_the_robot(model, data):
    """Sums (2, 3) N of MuJoCo's contact forces between table and robot, and table and free hand."""
    table, sums = model.geom("table").id, np.zeros((2, 3))
    hand = [model.geom(name).id for name in free_hand(model)]
    for index, contact in enumerate(data.contact[: data.ncon]):
        if table in contact.geom:
            wrench = np.zeros(6)
            mujoco.mj_contactForce(model, data, index, wrench)
            force = contact.frame.reshape(3, 3).T @ wrench[:3] * (1.0 if contact.geom[0] == table else -1.0)
            sums += np.array([force, force * np.isin(contact.geom, hand).any()])
    return sums


def test_forces_on_the_table_are_mujocos_contact_forces(fresh):
    engine, model = fresh
    at = beside_the_table(model)
    engine.reset(EVERY, at, still(model))
    engine.advance(hold(engine, model), still(model))
    assert engine.table_force.shape == (WORLDS, 2, 2, 3)
    for world in range(WORLDS):
        data = mujoco.MjData(model)
        data.qpos[:], data.ctrl[:] = at[world], at[0, 7:]
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


def test_applied_force_moves_the_base(fresh, robot):
    engine, model = fresh
    engine.reset(EVERY, standing(model, lift=1.0), still(model))
    applied = still(model)
    applied[1, 0] = MASS[robot]  # 1 m/s^2 on the centre of mass, less what the swinging joints take
    engine.advance(hold(engine, model), applied)
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
    roomy, model = build("mjwarp")
    cramped, _ = build("mjwarp", contacts_per_world=2, constraints_per_world=8)
    for engine in (roomy, cramped):
        engine.advance(hold(engine, model), still(model))
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
