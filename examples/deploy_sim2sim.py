"""Play an exported policy in plain MuJoCo: the sim-to-sim test, and the starting point for a real robot.

    pace export runs/my_run out=robot                           # writes robot/policy.onnx and its contract
    python examples/deploy_sim2sim.py robot/policy.onnx         # 50 serves, prints their outcomes

Needs onnxruntime, mujoco and numpy, and of PACE the MJCF in pace/sim/assets and the reference player. One core is
enough.

:class:`pace.deploy.player.Controller` is what a robot runs: it calls the file with the current readings and with the
state that the last call gave. The rest stands in for the world: :class:`Robot` is MuJoCo with the joints' position
controllers and noisy, late sensors, :class:`Ball` a small model of flight and rebounds of its own. World frame: origin
on the floor below the table's centre, x towards the opponent, y to the robot's left, z up. SI units.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter, deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
if str(ROOT) not in sys.path:
    sys.path.append(str(ROOT))  # so that it runs from a checkout in which nothing is installed

from pace.deploy.player import Controller, Log  # noqa: E402

SCENE = ROOT / "pace" / "sim" / "assets" / "scene.xml"
GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s^2
PHYSICS_DT = 0.002  # s
BALL_DT = 0.001  # s: a ball at 10 m/s moves by half its radius
NET_THICKNESS = 0.002  # m
ROLLING = 0.4  # share of the slip that a hollow sphere loses when it stops slipping: 1 / (1 + 3/2)
NEAR_PADDLE = 0.3  # m: farther away the blade is left out
START = (-2.0, 0.35)  # m, x and y of the base (the paper's evaluation)
SERVE_START = np.array([1.35, 0.0, 1.03])  # m; y varies by +-0.1
SERVES = {  # m/s: vx, vy, vz (the paper's evaluation)
    "long": ((-6.5, -6.2), (-0.6, 0.2), (1.5, 1.9)),
    "mid_long": ((-6.2, -5.7), (-0.6, 0.2), (1.5, 1.9)),
    "short": ((-5.7, -5.2), (-0.6, 0.2), (1.5, 1.9)),
    "mixed": ((-6.5, -5.2), (-0.6, 0.2), (1.5, 1.9)),
}

Vector = np.ndarray
Frame = dict[str, np.ndarray]


class Blade(NamedTuple):
    """The paddle at one instant."""

    centre: Vector
    normal: Vector
    velocity: Vector
    rotation: Vector  # rad/s


class Contact(NamedTuple):
    """What the ball met, where, and the impulse (N s) that it left there."""

    surface: str
    position: Vector
    point: Vector
    impulse: Vector


class MeasuredAir:
    """Drag and lift by speed and spin: shares of the tables under ``ball["air"]``.

    Args: ball: as for :class:`Ball`; per_mass: 1/m, 1/2 rho A / m.
    """

    def __init__(self, ball: Mapping[str, Any], per_mass: float) -> None:
        self._drag, self._lift = ball["air"]["drag"], ball["air"]["lift"]
        self._radius = float(ball["radius"])
        self._shares = per_mass * ball["table_drag"], 8.0 / 3.0 * per_mass * self._radius * ball["table_lift"]

    def factors(self, speed: float, turning: float) -> tuple[float, float]:
        """Drag (1/m) and lift (1) at ``speed`` m/s and a spin of ``turning`` rad/s."""
        ratio = self._radius * turning / max(speed, 1e-3)
        drags = [np.interp(ratio, row["ratio"], row["coefficient"]) for row in self._drag]
        above = [np.polyval([row["quadratic"], row["linear"], row["constant"]], turning) for row in self._lift]
        below = [row["slope"] * turning + row["offset"] for row in self._lift]
        bends = [turning > row["bend"] for row in self._lift]
        lifts = np.maximum(np.where(bends, above, below), 0.0)
        drag = _by_speed(self._drag, drags, speed, beyond=True)
        return self._shares[0] * max(drag, 0.0), self._shares[1] * _by_speed(self._lift, lifts, speed, beyond=False)


def _by_speed(rows: list[Mapping[str, float]], values: Any, speed: float, beyond: bool) -> float:
    """Linear between the rows' speeds, held beyond them; ``beyond``: extrapolated above the last."""
    known = [row["speed"] for row in rows]
    value = float(np.interp(speed, known, values))
    if beyond and speed > known[-1]:
        value += (speed - known[-1]) / (known[-1] - known[-2]) * (values[-1] - values[-2])
    return value


class Ball:
    """A ball with drag and Magnus force that rebounds from table, net, floor and a moving paddle.

    Args: ball: the numbers of ``configs/ball/<name>.yaml``, with the table's under ``table``.
    Attributes: ``position``, ``velocity``, ``spin``, world frame.
    """

    def __init__(self, ball: Mapping[str, Any]) -> None:
        self.position, self.velocity, self.spin = SERVE_START.copy(), np.zeros(3), np.zeros(3)
        self.radius, self.mass = float(ball["radius"]), float(ball["mass"])
        per_mass = 0.5 * ball["air_density"] * np.pi * self.radius**2 / self.mass
        self._drag = per_mass * ball["drag_coefficient"]
        self._magnus = per_mass * self.radius * ball["magnus_coefficient"]
        self._air = MeasuredAir(ball, per_mass) if ball.get("air") else None  # none in files of before
        self._lowest = float(ball["min_restitution"])
        self.table: Mapping[str, float] = ball["table"]
        springing = ("tangential_restitution", "tangential_restitution_slope", "drilling_loss")
        self._springing = {"paddle": [ball.get(f"paddle_{name}", 0.0) for name in springing]}
        self._springing["table"] = [ball.get("table_tangential_restitution", 0.0), 0.0, 0.0]
        self._materials = {  # restitution, its slope (s/m), friction
            "table": tuple(ball[f"table_{name}"] for name in ("restitution", "restitution_slope", "friction")),
            "paddle": tuple(ball[f"paddle_{name}"] for name in ("restitution", "restitution_slope", "friction")),
            "net": (self.table["net_restitution"], 0.0, self.table["net_friction"]),
            "floor": (self.table["floor_restitution"], 0.0, self.table["floor_friction"]),
        }
        self._boxes = self._make_boxes()

    def _make_boxes(self) -> dict[str, tuple[Vector, Vector]]:
        """Centre and half sizes of table top and net."""
        t = self.table
        half = np.array([t["length"] / 2, t["width"] / 2, t["thickness"] / 2])
        net = np.array([NET_THICKNESS / 2, t["width"] / 2 + t["net_overhang"], t["net_height"] / 2])
        return {
            "table": (np.array([0.0, 0.0, t["height"] - t["thickness"] / 2]), half),
            "net": (np.array([0.0, 0.0, t["height"] + t["net_height"] / 2]), net),
        }

    def serve(self, position: Vector, velocity: Vector) -> None:
        """A new ball without spin."""
        self.position, self.velocity, self.spin = position.copy(), velocity.copy(), np.zeros(3)

    def step(self, dt: float, start: Blade, end: Blade) -> list[Contact]:
        """Fly ``dt`` s while the paddle moves from ``start`` to ``end``; the contacts on the way, at most one."""
        position, velocity = self.position, self.velocity
        near = np.abs(position - start.centre).max() < NEAR_PADDLE
        before = self._gaps(position, start if near else None)
        self._fly(dt)
        first, when = "", 1.0
        for surface, (gap, normal) in self._gaps(self.position, end if near else None).items():
            moving = end.velocity if surface == "paddle" else 0.0
            if gap >= 0.0 or (before[surface][0] < 0.0 and np.dot(self.velocity - moving, normal) >= 0.0):
                continue
            share = max(before[surface][0], 0.0) / max(before[surface][0] - gap, 1e-12)
            if share < when:
                first, when = surface, share
        if not first:
            return []
        self.position, self.velocity = position, velocity
        self._fly(when * dt)
        contact = self._rebound(first, _between(start, end, when))
        self._fly((1.0 - when) * dt)
        return [contact]

    def _fly(self, dt: float) -> None:
        """Free flight by the midpoint rule."""
        middle = self.velocity + 0.5 * dt * self._acceleration(self.velocity)
        self.position = self.position + dt * middle
        self.velocity = self.velocity + dt * self._acceleration(middle)

    def _acceleration(self, velocity: Vector) -> Vector:
        speed = float(np.sqrt(velocity @ velocity))
        drag, lift = self._drag, self._magnus
        if self._air is not None:
            drag, lift = np.add((drag, lift), self._air.factors(speed, float(np.sqrt(self.spin @ self.spin))))
        return GRAVITY - drag * speed * velocity + lift * _cross(self.spin, velocity)

    def _gaps(self, position: Vector, blade: Blade | None) -> dict[str, tuple[float, Vector]]:
        """Gap (m, negative inside) and unit normal from each surface to the ball."""
        gaps = {name: box_distance(position - centre, half) for name, (centre, half) in self._boxes.items()}
        gaps["floor"] = (position[2], np.array([0.0, 0.0, 1.0]))
        if blade is not None:
            size = self.table["paddle_radius"], self.table["paddle_half_thickness"]
            gaps["paddle"] = disc_distance(position - blade.centre, blade.normal, *size)
        return {name: (distance - self.radius, normal) for name, (distance, normal) in gaps.items()}

    def _rebound(self, surface: str, blade: Blade) -> Contact:
        """Impulse with Coulomb friction on a hollow sphere: it slides, or its slip is stopped or reversed (rubber)."""
        _, normal = self._gaps(self.position, blade)[surface]
        point = self.position - self.radius * normal
        moving = blade.velocity + _cross(blade.rotation, point - blade.centre) if surface == "paddle" else np.zeros(3)
        relative = self.velocity - moving
        approach = max(-float(relative @ normal), 0.0)
        restitution, slope, friction = self._materials[surface]
        push = (1.0 + max(restitution - slope * approach, self._lowest)) * approach
        slip = relative - self.radius * _cross(self.spin, normal)
        slip = slip - (slip @ normal) * normal
        slipping = float(np.sqrt(slip @ slip))
        springing, falling, drilling = self._springing.get(surface, (0.0, 0.0, 0.0))
        grip = ROLLING * (1.0 + max(springing - falling * slipping, -1.0))
        share = min(grip, friction * push / max(slipping, 1e-9))
        change = push * normal - share * slip
        self.velocity = self.velocity + change
        turned = (1.5 / self.radius) * share * _cross(normal, slip) - drilling * (self.spin @ normal) * normal
        self.spin = self.spin + turned
        if surface == "table":
            surface = "edge" if normal[2] <= 0.0 else "own" if self.position[0] < 0.0 else "opponent"
        return Contact(surface, self.position.copy(), point, -self.mass * change)


def _cross(a: Vector, b: Vector) -> Vector:
    """a x b; numpy's own takes ten times as long for single vectors."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _between(start: Blade, end: Blade, share: float) -> Blade:
    parts = [(1.0 - share) * a + share * b for a, b in zip(start, end, strict=True)]
    parts[1] /= np.linalg.norm(parts[1])
    return Blade(*parts)


def box_distance(offset: Vector, half: Vector) -> tuple[float, Vector]:
    """Signed distance (m) and outward normal at ``offset`` from the centre of a box along the world's axes."""
    side, beyond = np.where(offset < 0.0, -1.0, 1.0), np.abs(offset) - half
    outside = np.maximum(beyond, 0.0)
    distance = float(np.sqrt(outside @ outside))
    if distance > 0.0:
        return distance, outside * side / distance
    axis = int(np.argmax(beyond))
    normal = np.zeros(3)
    normal[axis] = side[axis]
    return float(beyond[axis]), normal


def disc_distance(offset: Vector, axis: Vector, radius: float, half_thickness: float) -> tuple[float, Vector]:
    """Signed distance (m) and outward normal at ``offset`` from the centre of a disc: two faces, a rim."""
    height = float(offset @ axis)
    radial = offset - height * axis
    reach = float(np.sqrt(radial @ radial))
    face, rim = np.copysign(1.0, height) * axis, radial / max(reach, 1e-9)
    above, beyond = abs(height) - half_thickness, reach - radius
    if above <= 0.0 or beyond <= 0.0:
        return (above, face) if above >= beyond else (beyond, rim)
    distance = float(np.hypot(above, beyond))
    return distance, (above * face + beyond * rim) / distance


def build_model(scene: Path, meta: Mapping[str, Any]) -> mujoco.MjModel:
    """The scene with the motors of the training: gains, effort and, where the file has it, the torque-speed line.

    The robot's parts touch each other as in the training.
    """
    robot = meta["config"]["robot"]["model"]  # in the folder of the scene, or a path
    file = scene.parent / robot if (scene.parent / robot).exists() else Path(robot)
    spec = mujoco.MjSpec.from_string(scene.read_text(encoding="utf-8"), include={"robot.xml": file.read_bytes()})
    speeds, stalls = (meta.get(key) or [None] * len(meta["joint_names"]) for key in ("max_speed", "stall_torque"))
    motors = zip(meta["joint_names"], meta["kp"], meta["kd"], meta["effort"], speeds, stalls, strict=True)
    for name, kp, kd, effort, speed, stall in motors:
        actuator = spec.actuator(name)
        if speed is None:
            actuator.set_to_position(kp=kp, kv=kd)
        else:  # in volts that are rad/s: torque = (V - w) stall / speed, V = w + speed / stall (kp (u - q) - kd w)
            position = int(mujoco.mjtCtrlInput.mjINPUT_POS)
            actuator.set_to_dcmotor(
                motorconst=[1.0, 1.0], resistance=speed / stall, controller=[kp, 0, kd, 0, 0, speed], ctrlspec=position
            )
        actuator.forcerange = [-effort, effort]
    for one, other in meta["config"]["robot"].get("self_collision", []):  # none in files of before
        spec.add_pair(geomname1=one, geomname2=other)
    return spec.compile()


class Robot:
    """The robot in MuJoCo, with position controllers on its joints, and sensors that are noisy and late.

    Args: meta: metadata of the policy's file; noise: times the noise and delays that it was trained with.
    """

    def __init__(self, meta: Mapping[str, Any], scene: Path, noise: float, random: np.random.Generator) -> None:
        self.meta, self.noise, self._random = meta, noise, random
        self.model = model = build_model(scene, meta)
        self.data = mujoco.MjData(model)
        joints = [model.joint(name) for name in meta["joint_names"]]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._qvel = np.array([joint.dofadr[0] for joint in joints])
        self._motors = np.array([model.actuator(name).id for name in meta["joint_names"]])
        self._paddle = model.site("paddle").id
        self._set_up(meta["config"]["engine"])
        self._late: deque[Frame] = deque(maxlen=1)
        self._targets: deque[Vector] = deque(maxlen=1)

    def _set_up(self, engine: Mapping[str, Any]) -> None:
        """Solver, armature (of each joint, or one number for all in files of before) and friction of the training."""
        model, meta = self.model, self.meta
        model.opt.timestep = PHYSICS_DT
        model.opt.iterations, model.opt.ls_iterations = engine["solver_iterations"], engine["line_search_iterations"]
        model.dof_armature[self._qvel] = meta["armature"]
        model.dof_frictionloss[self._qvel] = meta.get("friction", 0.0)

    def _draw_steps(self, delay: list[float]) -> int:
        return round(self.noise * self._random.uniform(delay[0], delay[1]) / PHYSICS_DT)

    def reset(self, ball: Vector) -> None:
        """Stand in the nominal pose at the start; resample the delays."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:7] = (*START, self.meta["config"]["robot"]["base_height"], 1.0, 0.0, 0.0, 0.0)
        self.data.qpos[self._qpos] = self.meta["nominal_pose"]
        mujoco.mj_step1(self.model, self.data)
        steps = self._draw_steps(self.meta["sensing"]["mocap_delay"])
        self._late = deque([self._mocap(ball)] * (steps + 1), maxlen=steps + 1)
        steps = self._draw_steps(self.meta["actuator_delay"])
        self._targets = deque([np.array(self.meta["nominal_pose"])] * (steps + 1), maxlen=steps + 1)

    def step(self, target: Vector, impulse: Contact | None, ball: Vector) -> None:
        """One physics step towards joint targets, with the ball's last impulse on the paddle."""
        self._targets.append(target)
        self.data.ctrl[self._motors] = self._targets[0]
        self.data.qfrc_applied[:] = 0.0
        if impulse is not None:
            body, force = self.model.site_bodyid[self._paddle], impulse.impulse / PHYSICS_DT
            where = (force, np.zeros(3), impulse.point, body, self.data.qfrc_applied)
            mujoco.mj_applyFT(self.model, self.data, *where)
        mujoco.mj_step2(self.model, self.data)
        mujoco.mj_step1(self.model, self.data)  # poses and velocities of the new state
        self._late.append(self._mocap(ball))

    def _mocap(self, ball: Vector) -> Frame:
        x_axis = self.data.body("Trunk").xmat[[0, 3]]
        heading = x_axis / max(float(np.linalg.norm(x_axis)), 1e-6)
        return {"base_position": self.data.qpos[:3].copy(), "heading": heading, "ball_position": ball.copy()}

    def sense(self) -> Frame:
        """The sensors' current readings, by the names of the file's inputs."""
        rotation = self.data.body("Trunk").xmat.reshape(3, 3)
        truth = {
            "base_angular_velocity": self.data.qvel[3:6],
            "projected_gravity": -rotation[2],
            "joint_position": self.data.qpos[self._qpos],
            "joint_velocity": self.data.qvel[self._qvel],
            **self._late[0],
        }
        amplitude = {name: self.noise * self.meta["sensing"][name] for name in truth}
        seen = {n: v + amplitude[n] * self._random.uniform(-1.0, 1.0, v.shape) for n, v in truth.items()}
        age = PHYSICS_DT * (len(self._late) - 1)
        stamps = dict.fromkeys(("base_age", "ball_age"), np.array([age]))
        return seen | stamps | dict.fromkeys(("base_new", "ball_new"), np.ones(1))  # a frame at each control step

    @property
    def blade(self) -> Blade:
        """The paddle now."""
        velocity = np.zeros(6)
        kind = mujoco.mjtObj.mjOBJ_SITE
        mujoco.mj_objectVelocity(self.model, self.data, kind, self._paddle, velocity, 0)
        site = self.data.site(self._paddle)
        return Blade(site.xpos.copy(), site.xmat[[0, 3, 6]].copy(), velocity[3:], velocity[:3])

    @property
    def lost(self) -> bool:
        """Fallen, or outside of its area."""
        rule, base = self.meta["config"]["reset"], self.data.qpos[:3]
        bounds = (rule["bounds_x"], rule["bounds_y"])
        inside = all(low <= value <= high for value, (low, high) in zip(base[:2], bounds, strict=True))
        return not inside or base[2] < rule["min_base_height"]


class Referee:
    """Judges one serve: a hit is paddle contact after exactly one bounce on the own half; a return then lands first on
    the opponent's half.
    """

    def __init__(self) -> None:
        self.bounces, self.hit, self.outcome = 0, False, ""

    def see(self, contact: Contact) -> None:
        """Take in the next contact of the ball."""
        surface = contact.surface
        if self.outcome:
            return
        if self.hit:
            names = {"opponent": "success", "own": "own side", "paddle": "double hit", "floor": "out", "edge": "out"}
            self.outcome = names.get(surface, "")  # the net alone decides nothing
        elif surface == "paddle":
            self.hit = self.bounces == 1
            self.outcome = "" if self.hit else "volley"
        elif surface == "own":
            self.bounces += 1
            self.outcome = "miss" if self.bounces > 1 else ""
        elif surface in ("floor", "edge"):
            self.outcome = "miss"


class Match:
    """Serve after serve, and their outcomes.

    Attributes: ``results`` outcome -> count, ``hits``, ``clock`` s played.
    """

    def __init__(
        self, controller: Controller, robot: Robot, ball: Ball, serve: str, seed: int, log: Log | None = None
    ) -> None:
        self.controller, self.robot, self.ball = controller, robot, ball
        self._log, self._fresh = log, True
        self._ranges, self._random = SERVES[serve], np.random.default_rng(seed)
        self._rules: Mapping[str, float] = controller.meta["config"]["serve"]
        self.results: Counter[str] = Counter()
        self.hits, self.clock = 0, 0.0

    def _launch(self) -> None:
        start = SERVE_START.copy()
        start[1] += self._random.uniform(-0.1, 0.1)
        self.ball.serve(start, np.array([self._random.uniform(*bounds) for bounds in self._ranges]))

    def play(self, serves: int) -> None:
        """Play so many serves; after a fall the robot is reset."""
        standing = False
        for _ in range(serves):
            self._launch()
            if not standing:
                self.robot.reset(self.ball.position)
                self.controller.restart()
                self._fresh = True
            referee, standing = self._rally()
            self.hits += referee.hit
            self.results[referee.outcome or ("out" if referee.hit else "miss")] += 1

    def _rally(self) -> tuple[Referee, bool]:
        """One serve to its end: its referee, and whether the robot still stands."""
        referee, played = Referee(), 0.0
        while played < self._rules["max_duration"] and self.ball.position[2] > self._rules["end_height"]:
            contacts = self._control_step()
            for contact in contacts:
                referee.see(contact)
            played += self.controller.control_dt
            if self.robot.lost:
                referee.outcome = referee.outcome or "fall"
                return referee, False
            if any(contact.surface == "floor" for contact in contacts):
                break
        return referee, True

    def _control_step(self) -> list[Contact]:
        readings = self.robot.sense()
        target = self.controller(readings)
        if self._log is not None:
            self._log.add(self.clock, readings, target, self._fresh)
        self._fresh = False
        contacts: list[Contact] = []
        struck: Contact | None = None
        for _ in range(round(self.controller.control_dt / PHYSICS_DT)):
            before = self.robot.blade
            self.robot.step(target, struck, self.ball.position)
            met = self._fly(before, self.robot.blade)
            struck = next((contact for contact in met if contact.surface == "paddle"), None)
            contacts += met
        self.clock += self.controller.control_dt
        return contacts

    def _fly(self, before: Blade, after: Blade) -> list[Contact]:
        """The ball over one physics step, in shorter sub-steps."""
        steps = round(PHYSICS_DT / BALL_DT)
        knots = [_between(before, after, i / steps) for i in range(steps + 1)]
        return [contact for i in range(steps) for contact in self.ball.step(BALL_DT, knots[i], knots[i + 1])]


def report(match: Match, seconds: float) -> str:
    """Rates, outcomes and speed."""
    total = sum(match.results.values())
    outcomes = ", ".join(f"{count} {name}" for name, count in match.results.most_common())
    return (
        f"{total} serves: hit {match.hits / total:.1%}, success {match.results['success'] / total:.1%} ({outcomes})\n"
        f"{match.clock:.1f} s of play took {seconds:.1f} s of one core: {match.clock / seconds:.1f} times real time"
    )


def main() -> int:
    """Entry point; returns the exit status."""
    parser = argparse.ArgumentParser(description="Play an exported policy in plain MuJoCo.")
    parser.add_argument("policy", type=Path, help="policy.onnx of pace export, its contract beside it")
    parser.add_argument("--serves", type=int, default=50)
    parser.add_argument("--serve", choices=SERVES, default="mixed", help="serve range of the paper's evaluation")
    parser.add_argument("--noise", type=float, default=1.0, help="times the noise and delays of the training")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--log", type=Path, help="file to record readings and targets in, for pace retrace")
    parser.add_argument("--scene", type=Path, default=SCENE, help="MJCF of the table, beside that of the robot")
    options = parser.parse_args()
    if options.serves < 1 or options.seed < 0 or not 0.0 <= options.noise < float("inf"):
        parser.error("--serves must be at least 1, --seed and --noise not negative")
    try:
        controller = Controller(options.policy)
    except ValueError as error:
        print(f"error: {options.policy} cannot be used: {error}", file=sys.stderr)
        return 1
    random = np.random.default_rng(options.seed)
    robot = Robot(controller.meta, options.scene, options.noise, random)
    log = Log(options.log, controller.sizes, len(controller.contract["joint_names"])) if options.log else None
    match = Match(controller, robot, Ball(controller.meta["config"]["ball"]), options.serve, options.seed, log)
    ball = controller.meta["config"]["ball"]
    print(f"policy {controller.meta['source']}, serves {options.serve}, ball {ball['name']}", flush=True)
    started = time.process_time()
    try:
        match.play(options.serves)
    except ValueError as error:  # of the controller
        print(f"error: {options.policy} cannot be played: {error}", file=sys.stderr)
        return 1
    finally:
        if log is not None:
            log.close()
    print(report(match, time.process_time() - started))
    return 0


if __name__ == "__main__":
    sys.exit(main())
