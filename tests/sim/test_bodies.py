"""The robot's body as a surface for the ball: against MuJoCo's distances, closed forms and finely sampled motion."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import root_scalar

from pace.config.ball import TableConfig
from pace.config.base import ConfigError
from pace.config.training import load_train_config
from pace.sim.ball.aero import GRAVITY
from pace.sim.ball.ball import BallParams, BallSim
from pace.sim.ball.robot_body import RobotBody, body_velocity, nearest_shape
from pace.sim.bodies import Bodies
from pace.sim.body_shapes import shapes_of
from pace.sim.kinematics import Kinematics
from pace.sim.robot import VISUAL_GROUP, build_model
from pace.sim.robot_spec import ASSETS, RobotSpec
from pace.studies import ball_reference as reference

Array = NDArray[np.float64]
CPU = torch.device("cpu")
RADIUS = 0.02
DT, SUBSTEPS = 0.02, 2
KNOTS = np.linspace(0.0, DT, SUBSTEPS + 1)
TRUNK = '<geom name="trunk"'
#: Kinds of geoms that the T1 lacks.
MORE = """<geom name="can" class="body" type="cylinder" size="0.05 0.08" pos="-0.25 0 0.3" quat="0.9 0.3 0.1 0.3"/>
<geom name="box" class="body" type="box" size="0.02 0.06 0.09" pos="-0.25 0.3 0.3" quat="0.8 0.4 0.4 0.2"/>
"""
TABLE: TableConfig = load_train_config().ball.table
VACUUM = replace(BallParams.preset("rubber"), air_density=0.0)


@lru_cache
def scene(robot: str = "t1", more: str = "") -> mujoco.MjModel:
    """The model with the ball's geom, which physics leaves out; ``more``: a file with more geoms on the trunk."""
    config = load_train_config([f"robot={robot}"])
    chosen = replace(config.robot, model=more) if more else config.robot
    return build_model(chosen, config.engine, TABLE, visual=True)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> mujoco.MjModel:
    """The T1 with every kind of shape."""
    file: Path = tmp_path_factory.mktemp("robot") / "more.xml"
    text = (ASSETS / "t1_paddle.xml").read_text()
    assert TRUNK in text
    file.write_text(text.replace(TRUNK, MORE + TRUNK))
    return scene(more=str(file))


def geoms(model: mujoco.MjModel) -> list[int]:
    """The robot's collision geoms but the paddle."""
    own = [g for g in range(model.ngeom) if model.body_rootid[model.geom_bodyid[g]] == model.body("Trunk").id]
    return [g for g in own if model.geom_group[g] != VISUAL_GROUP and model.geom(g).name != "paddle"]


def poses(model: mujoco.MjModel, count: int, seed: int) -> Array:
    """Random states (count, nq): turned bases, joints within their limits."""
    generator = np.random.default_rng(seed)
    qpos = np.zeros((count, model.nq))
    qpos[:, :3] = generator.uniform([-2.0, -0.3, 0.6], [-1.6, 0.3, 0.8], (count, 3))
    qpos[:, 3:7] = [1.0, 0.0, 0.0, 0.0] + 0.3 * generator.normal(size=(count, 4))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qpos[:, 7:] = generator.uniform(model.jnt_range[1:, 0], model.jnt_range[1:, 1], (count, model.nq - 7))
    return qpos


def moving(model: mujoco.MjModel, start: Array, rate: Array, times: ArrayLike) -> Array:
    """States (N, T, nq) that move from ``start`` (N, nq) with the constant velocities ``rate`` (N, nv)."""
    path = np.zeros((len(start), len(np.atleast_1d(times)), model.nq))
    for world, qpos in enumerate(start):
        for i, time in enumerate(np.atleast_1d(times)):
            path[world, i] = qpos
            mujoco.mj_integratePos(model, path[world, i], rate[world], float(time))
    return path


class Rig:
    """Robots of MuJoCo's path (N, S + 1, nq) and a ball each, without air."""

    def __init__(self, model: mujoco.MjModel, path: Array, hand: tuple[str, ...] = (), robot: str = "t1") -> None:
        worlds = len(path)
        tips = RobotSpec.of(load_train_config([f"robot={robot}"]).robot).tips
        qpos = torch.tensor(path, dtype=torch.float32)
        qvel = torch.zeros(worlds, SUBSTEPS + 1, model.nv)
        kinematics = Kinematics(model, tips, worlds, SUBSTEPS, CPU)
        kinematics.update(qpos, qvel)
        self.path = kinematics.paddle_path
        self.bodies = Bodies(model, hand, worlds, SUBSTEPS, DT, CPU)
        self.ball = BallSim(worlds, CPU, VACUUM, TABLE, DT, SUBSTEPS, 0.02, robot=self.bodies.surface)
        self.pose = self.bodies.poser(qpos, self.path, self.ball)

    def fly(self, position: ArrayLike, velocity: ArrayLike, spin: ArrayLike = 0.0) -> BallSim:
        """A control step from these states (N, 3)."""
        for tensor, value in zip(
            (self.ball.position, self.ball.velocity, self.ball.spin), (position, velocity, spin), strict=True
        ):
            tensor.copy_(torch.as_tensor(np.broadcast_to(value, tensor.shape).copy()))
        self.pose()
        self.ball.fly(self.path)
        return self.ball

    def nearest(self, points: Array, clock: float) -> Array:
        """Shape, distance (m), normal and velocity (m/s) of the body (N, 8) nearest to ``points`` (N, 3)."""
        self.ball.position.copy_(torch.as_tensor(points))
        self.ball.velocity.fill_(20.0)  # so that all that is within 0.4 m is near
        self.pose()
        out = wp.zeros((len(points), 8), dtype=wp.float32, device="cpu")
        given = [self.bodies.surface, wp.array(points, dtype=wp.vec3, device="cpu"), clock, DT / SUBSTEPS, out]
        wp.launch(_nearest, dim=len(points), inputs=given, device="cpu")
        return out.numpy().astype(float)


@wp.kernel
def _nearest(body: RobotBody, points: wp.array[wp.vec3], clock: float, path_dt: float, out: wp.array2d[float]):
    world = wp.tid()
    found = nearest_shape(body, world, points[world], clock, path_dt)
    velocity = body_velocity(body, world, found.shape, points[world], clock, path_dt)
    out[world, 0] = float(found.shape)
    out[world, 1] = found.distance
    for i in range(3):
        out[world, 2 + i] = found.normal[i]
        out[world, 5 + i] = velocity[i]


class Judge:
    """MuJoCo's collision of a sphere of ``radius`` m with the robot, at any state."""

    def __init__(self, model: mujoco.MjModel, radius: float = RADIUS) -> None:
        self.model, self.ball, self.geoms = copy(model), model.geom("ball").id, geoms(model)
        self.model.geom_size[self.ball, 0] = radius
        self.data = mujoco.MjData(self.model)

    def put(self, qpos: Array, ball: Array) -> None:
        self.data.qpos[:], self.data.mocap_pos[0] = qpos, ball
        mujoco.mj_kinematics(self.model, self.data)

    def gap(self) -> tuple[float, int, Array]:
        """Smallest gap (m) of the ball, to which geom, and the unit normal from it (where they are apart)."""
        least, nearest, normal = np.inf, -1, np.zeros(3)
        for geom in self.geoms:
            fromto = np.zeros(6)
            distance = mujoco.mj_geomDistance(self.model, self.data, geom, self.ball, 1.0, fromto)
            if distance < least:
                least, nearest, normal = distance, geom, (fromto[3:] - fromto[:3]) / (abs(distance) + 1e-12)
        return least, nearest, normal


def fallen(position: Array, velocity: Array, time: float) -> Array:
    """Where a ball without air is ``time`` s later."""
    return position + time * velocity - np.array([0.0, 0.0, 0.5 * GRAVITY * time**2])


def beside(model: mujoco.MjModel, qpos: Array, seed: int, reach: float) -> Array:
    """A point (N, 3) within ``reach`` m of a random geom of each state."""
    generator, judge = np.random.default_rng(seed), Judge(model)
    points = np.zeros((len(qpos), 3))
    for world, state in enumerate(qpos):
        judge.put(state, np.zeros(3))
        offset = generator.normal(size=3)
        offset *= reach * generator.random() / np.linalg.norm(offset)
        points[world] = judge.data.geom_xpos[generator.choice(judge.geoms)] + offset
    return points


# --- shapes -----------------------------------------------------------------------------------------------------------


def test_shapes_are_all_collision_geoms_but_the_paddle(model: mujoco.MjModel) -> None:
    for built, more in ((scene(), 0), (model, 2), (scene("t1_29dof"), 2)):  # two more: hands
        assert len(shapes_of(built, ())) == len(geoms(built)) == 18 + more
    kinds = {int(model.geom_type[g]) for g in geoms(model)}
    assert kinds == {int(k) for k in (2, 3, 5, 6)}  # sphere, capsule, cylinder, box


@pytest.mark.parametrize("robot", ["every shape", "t1_29dof"])
def test_distance_and_normal_are_mujocos(model: mujoco.MjModel, robot: str) -> None:
    if robot == "t1_29dof":
        model = scene(robot)
    qpos = poses(model, 400, seed=1)
    points = beside(model, qpos, 2, 0.2)
    found = Rig(model, qpos[:, None].repeat(SUBSTEPS + 1, 1), robot="t1").nearest(points, 0.007)
    judge, touched = Judge(model), set()
    for state, point, row in zip(qpos, points, found, strict=True):
        judge.put(state, point)
        gap, geom, normal = judge.gap()
        assert row[1] - RADIUS == pytest.approx(gap, abs=2e-5)
        if gap > 1e-3:
            np.testing.assert_allclose(row[2:5], normal, atol=2e-3)
        touched.add(int(model.geom_type[geom]))
        np.testing.assert_allclose(row[5:], 0.0, atol=1e-6)
    assert len(touched) == len({int(model.geom_type[g]) for g in judge.geoms})


def test_other_geoms_count_as_their_bounding_box(tmp_path: Path) -> None:
    text = (ASSETS / "t1_paddle.xml").read_text()
    egg = '<geom class="body" type="ellipsoid" size="0.03 0.05 0.07" pos="-0.3 0.1 0.2" quat="0.6 0.8 0 0"/>'
    (tmp_path / "egg.xml").write_text(text.replace(TRUNK, egg + TRUNK))
    shape = shapes_of(scene(more=str(tmp_path / "egg.xml")), ())[0]
    assert shape.half == pytest.approx((0.03, 0.05, 0.07))
    np.testing.assert_allclose(shape.centre, [-0.3, 0.1, 0.2])
    np.testing.assert_allclose(shape.quat, [0.6, 0.8, 0.0, 0.0])


# --- contacts ---------------------------------------------------------------------------------------------------------


def shots(model: mujoco.MjModel, qpos: Array, seed: int, speed: float) -> tuple[Array, Array]:
    """Balls (N, 3) that are aimed at a point beside the robot, from 0.1 to 0.3 m away, at ``speed`` m/s."""
    generator = np.random.default_rng(seed)
    velocity = generator.normal(size=(len(qpos), 3))
    velocity *= speed / np.linalg.norm(velocity, axis=1, keepdims=True)
    way = generator.uniform(0.1, 0.3, (len(qpos), 1))
    return beside(model, qpos, seed + 1, 0.1) - way * velocity / speed, velocity


def first_touch(judge: Judge, path: Array, position: Array, velocity: Array, times: Array) -> tuple[float, float]:
    """When a ball first touches the robot, by fine sampling and, for one that stands, by bisection; inf if it does not.
    And the smallest gap."""

    def gap(time: float, qpos: Array) -> float:
        judge.put(qpos, fallen(position, velocity, time))
        return judge.gap()[0]

    gaps = [gap(time, qpos) for time, qpos in zip(times, path, strict=True)]
    inside = np.flatnonzero(np.array(gaps) < 0.0)
    if not len(inside):
        return np.inf, min(gaps)
    last = int(inside[0])
    if last == 0 or (path[last] != path[last - 1]).any():
        return float(times[last]), min(gaps)
    touch = root_scalar(gap, args=(path[last],), bracket=(times[last - 1], times[last]), method="brentq", xtol=1e-9)
    return float(touch.root), min(gaps)


def clear(model: mujoco.MjModel, position: Array, qpos: Array) -> NDArray[np.bool_]:
    """Balls (N,) that begin off the robot and will meet nothing else: above the table's height, or behind its end."""
    judge, free = Judge(model), np.zeros(len(qpos), dtype=bool)
    for world, state in enumerate(qpos):
        judge.put(state, position[world])
        paddle = np.linalg.norm(judge.data.geom("paddle").xpos - position[world])
        free[world] = judge.gap()[0] > 1e-3 and paddle > 0.7 and position[world, 2] > 0.45
    return free & (position[:, 0] < -1.37 - 0.45)


@pytest.mark.parametrize(("speed", "turning"), [(18.0, 0.0), (6.0, 0.0), (12.0, 6.0)])
def test_balls_meet_the_body_where_fine_sampling_finds_it(model: mujoco.MjModel, speed: float, turning: float) -> None:
    """A robot that stands, and one whose base and joints move at up to ``turning`` m/s and rad/s."""
    count, times = 400, np.linspace(0.0, DT, 201)
    qpos = poses(model, count, seed=5)
    qpos[:, 0] -= 0.6
    rate = np.random.default_rng(6).uniform(-turning, turning, (count, model.nv))
    path = moving(model, qpos, rate, times)
    position, velocity = shots(model, path[:, 100], 7, speed)
    rig = Rig(model, path[:, :: len(times) // SUBSTEPS])
    events, judge, met = rig.fly(position, velocity).events, Judge(model), 0
    slack = 1e-4 if turning == 0.0 else 3e-3  # m: of the interpolated motion
    for world in np.flatnonzero(clear(model, position, qpos)):
        time, least = first_touch(judge, path[world], position[world], velocity[world], times)
        if abs(least) < slack:
            continue
        assert bool(events.body[world]) is (least < 0.0), f"world {world}: smallest gap {least}"
        if least < 0.0:
            met += 1
            assert float(events.body_time[world]) == pytest.approx(time, abs=5e-6 if turning == 0.0 else 2e-3)
    assert met > 30


@pytest.mark.parametrize(("beyond", "touched"), [(0.001, False), (-0.001, True)])
def test_a_ball_that_passes_1_mm_beside_is_not_touched(model: mujoco.MjModel, beyond: float, touched: bool) -> None:
    count, times = 200, np.linspace(0.0, DT, 101)
    qpos = poses(model, count, seed=9)
    qpos[:, 0] -= 0.6
    position, velocity = shots(model, qpos, 10, 15.0)
    judge, free = Judge(model), clear(model, position, qpos)
    for world in np.flatnonzero(free):
        for _ in range(20):  # move the ball's line along the normal at its nearest point
            gaps = []
            for time in times:
                judge.put(qpos[world], fallen(position[world], velocity[world], time))
                gaps.append(judge.gap())
            gap, _, normal = min(gaps, key=lambda found: found[0])
            if abs(gap - beyond) < 1e-4 or gap < -0.01:
                break
            position[world] += (beyond - gap) * normal * np.sign(gap)
        free[world] = abs(gap - beyond) < 1e-4 and clear(model, position[[world]], qpos[[world]])[0]
    events = Rig(model, qpos[:, None].repeat(SUBSTEPS + 1, 1)).fly(position, velocity).events
    assert free.sum() > 20
    assert ((events.body > 0).numpy() == touched)[free].all()


def test_the_rebound_is_the_closed_form_in_the_frame_of_the_body(model: mujoco.MjModel) -> None:
    """A robot that translates: the same as one that stands, met by a ball of the relative velocity."""
    count = 200
    qpos = poses(model, count, seed=11)
    qpos[:, 0] -= 0.6
    drift = np.random.default_rng(12).uniform(-3.0, 3.0, (count, 3))
    rate = np.concatenate([drift, np.zeros((count, model.nv - 3))], axis=1)
    position, velocity = shots(model, qpos, 13, 12.0)
    spin = np.random.default_rng(14).uniform(-50.0, 50.0, (count, 3))
    free = clear(model, position, qpos)
    still = Rig(model, moving(model, qpos, 0 * rate, KNOTS)).fly(position, velocity, spin)
    moved = Rig(model, moving(model, qpos, rate, KNOTS)).fly(position, velocity + drift, spin)
    met = torch.as_tensor(free) & (still.events.body == 1)
    once = met.numpy()
    assert once.sum() > 30
    np.testing.assert_allclose(moved.events.body_time[met], still.events.body_time[met], atol=1e-5)
    np.testing.assert_allclose(moved.velocity[met], (still.velocity + torch.as_tensor(drift))[met], atol=2e-3)
    np.testing.assert_allclose(moved.spin[met], still.spin[met], atol=0.2)
    core, normal, time = Judge(model, radius=0.01), np.zeros((count, 3)), still.events.body_time.numpy().astype(float)
    for world in np.flatnonzero(once):
        core.put(qpos[world], fallen(position[world], velocity[world], time[world]))
        gap, _, normal[world] = core.gap()
        assert gap == pytest.approx(0.01, abs=2e-5)
    falling = np.array([0.0, 0.0, GRAVITY])
    arriving = velocity[once] - time[once, None] * falling
    radius, restitution, friction = np.full(
        (3, once.sum()), [[RADIUS], [TABLE.body_restitution], [TABLE.body_friction]]
    )
    given = (arriving, spin[once], normal[once], np.zeros(3), radius, restitution, friction)
    leaving, turning = reference.rebound(*given)
    leaving -= (DT - time[once, None]) * falling
    np.testing.assert_allclose(still.velocity[met], leaving, atol=0.02)
    np.testing.assert_allclose(still.spin[met], turning, atol=1.0)


def test_the_body_moves_as_mujocos_between_two_instants(model: mujoco.MjModel) -> None:
    """Off by a dt^2 / 8, a the acceleration: 0.7 mm at 10 rad/s and 0.55 m; velocities by a dt / 2."""
    count, rates = 200, 8.0
    qpos = poses(model, count, seed=15)
    rate = np.random.default_rng(16).uniform(-rates, rates, (count, model.nv))
    rate[:, :6] = 0.0
    rig, judge = Rig(model, moving(model, qpos, rate, KNOTS)), Judge(model)
    middle = moving(model, qpos, rate, DT / 4)[:, 0]
    points = beside(model, middle, 17, 0.12)
    found, errors = rig.nearest(points, DT / 4), []
    for world, row in enumerate(found):
        judge.put(middle[world], points[world])
        errors.append(row[1] - RADIUS - judge.gap()[0])
    assert np.abs(errors).max() < 2.5e-3
    assert np.sqrt(np.mean(np.square(errors))) < 4e-4


def test_a_far_robot_changes_nothing() -> None:
    model = scene()
    qpos = poses(model, 50, seed=18)
    position, velocity = np.array([0.5, 0.1, 1.1]), np.array([-5.0, 0.2, 0.5])
    rig = Rig(model, qpos[:, None].repeat(SUBSTEPS + 1, 1))
    alone = BallSim(50, CPU, VACUUM, TABLE, DT, SUBSTEPS, 0.02)
    ball = rig.fly(position, velocity)
    alone.position.copy_(torch.as_tensor(position))
    alone.velocity.copy_(torch.as_tensor(velocity))
    alone.fly(rig.path)
    assert not rig.bodies.surface.near_count.numpy().any()
    assert torch.equal(ball.position, alone.position)
    assert torch.equal(ball.velocity, alone.velocity)


def test_a_ball_rests_on_a_body_and_counts_once() -> None:
    model = scene()
    qpos = np.zeros((1, model.nq))
    qpos[0, :7] = [-2.5, 0.0, 0.7, 1.0, 0.0, 0.0, 0.0]
    rig = Rig(model, qpos[:, None].repeat(SUBSTEPS + 1, 1))
    ball, count = rig.fly([-2.40, 0.0, 0.7 + 0.27 + RADIUS + 1e-4], 0.0), 0
    for _ in range(60):
        count += int(ball.events.body[0])
        rig.pose()
        ball.fly(rig.path)
    assert count <= 3
    assert float(ball.position[0, 2]) == pytest.approx(0.7 + 0.27 + RADIUS, abs=1e-4)  # on the trunk's upper face


# --- the hand that holds the paddle -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("hand", "kind"), [((), "body"), (("right_forearm",), "paddle_hit")])
def test_the_hand_that_holds_the_paddle_hits_as_the_paddle_does(hand: tuple[str, ...], kind: str) -> None:
    model = scene()
    qpos = np.zeros((1, model.nq))
    qpos[0, :7] = [-2.5, 0.0, 0.7, 1.0, 0.0, 0.0, 0.0]
    judge = Judge(model)
    judge.put(qpos[0], np.zeros(3))
    forearm = judge.data.geom("right_forearm").xpos
    ball = Rig(model, qpos[:, None].repeat(SUBSTEPS + 1, 1), hand).fly(
        forearm + np.array([0.1, 0.0, 0.0]), [-8.0, 0.0, 0.0]
    )
    assert {name: int(getattr(ball.events, name)) for name in ("body", "paddle_hit")} == {
        name: int(name == kind) for name in ("body", "paddle_hit")
    }
    assert float(getattr(ball.events, f"{kind}_time")) == pytest.approx(0.05 / 8.0, abs=1e-4)
    assert float(ball.velocity[0, 0]) == pytest.approx(8.0 * TABLE.body_restitution, rel=1e-3)
    assert bool(ball.events.hit_rim) is (kind == "paddle_hit")
    assert (float(ball.events.paddle_impulse[0, 0]) < -0.03) is (kind == "paddle_hit")


def test_hands_are_named_by_body_or_geom() -> None:
    model = scene("t1_29dof")
    for names, count in ((("AR4", "left_forearm"), 2), (("right_hand_link",), 1), (("paddle",), 0), ((), 0)):
        assert sum(shape.hand for shape in shapes_of(model, names)) == count
    with pytest.raises(ConfigError, match=r"robot\.paddle_hand: the robot has no body or geom third_hand"):
        shapes_of(model, ("AR4", "third_hand"))
