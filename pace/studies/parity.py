"""The two engines over one second of the same random targets from the same states: standing, falling, striking.

Motion on a rigid floor is chaotic: one contact a step earlier separates two robots. So the difference of the engines is
compared with that of MuJoCo with itself, started 1 urad off. If trunk (box) or paddle (cylinder) touch table or body,
the engines use different algorithms and may find other points; such worlds are listed separately.

A pyramidal friction cone depends on the contact's axes, and MuJoCo Warp chooses those of a steep capsule on the floor
differently (its plane_capsule has a fixed axis if the capsule stands above 60 degrees; MuJoCo always the capsule's).
An elliptic cone does not depend on them: with it, falls on limbs alone agree too.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import mujoco
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from pace.runs.metrics import markdown
from pace.sim.robot_spec import TOUCH
from pace.sim.worlds import Worlds
from pace.studies.common import COLOURS, Array, model_of, smooth_swings, standing, study_config, study_spec
from pace.studies.throws import throw

STEPS = 50  # control steps: one second
INSTANTS = (5, 10, 25, 50)  # control steps after which differences are quoted
THROWS = (10, 22, 34, 46)  # control steps before which a ball is thrown at the paddle
NUDGE = 1e-6  # rad
SEED = 11
#: Engine and initial offset of each comparison with ``native``.
OTHERS = {"mjwarp": ("mjwarp", 0.0), "native, 1 μrad beside": ("native", NUDGE)}

#: Bodies (a box, a cylinder) whose contacts are found by a general convex algorithm.
CONVEX_BODIES = ("trunk", "paddle")

#: Falls without the known differences of the engines.
LIMBS_ELLIPTIC = "falling, limbs only, elliptic cone"

Balls = list[tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Play:
    """A second of N worlds: (T, N, ...) after each control step."""

    joints: Array  # (T, N, J) rad
    base: Array  # (T, N, 7) m, quaternion
    load: Array  # (T, N, 2) N, vertical force on the feet
    paddle: Array  # (T, N, 12)
    ball: Array  # (T, N, 3) m/s
    touched: Array  # (T, N) 1 if trunk or paddle touched anything at the end of a control step


@dataclass(frozen=True)
class Difference:
    """Difference of two rollouts, (T, N)."""

    joints: Array  # rad, largest of all joints
    base: Array  # m
    angle: Array  # rad, of the base
    load: Array  # (N,) N, mean over the second of the load on both feet
    paddle: Array  # m
    ball: Array  # m/s
    convex: NDArray[np.bool_]  # (N,), trunk or paddle touched anything in one of the two

    def worlds(self, chosen: NDArray[np.bool_]) -> Difference:
        """The same of some worlds (N,)."""
        return Difference(**{f.name: getattr(self, f.name)[..., chosen] for f in fields(self)})


@dataclass(frozen=True)
class Scenario:
    """Start velocities (N, 6 + J), joint targets (T, N, J) rad, whether balls are thrown at the paddle, and which
    bodies touch."""

    velocity: Tensor
    targets: Tensor
    strikes: bool = False
    convex: bool = True  # CONVEX_BODIES collide; otherwise they pass through everything
    cone: str = "pyramidal"


def scenarios(num_worlds: int, nominal: Tensor) -> dict[str, Scenario]:
    """Standing under shaking joints; falling over, with and without general convex contacts; strikes in mid-swing."""
    generator = torch.Generator().manual_seed(SEED)
    shaking = torch.randn(STEPS, num_worlds, len(nominal), generator=generator)
    still = torch.zeros(num_worlds, 6 + len(nominal))
    pushed = still.clone()
    angle = 2 * np.pi * torch.rand(num_worlds, generator=generator)
    pushed[:, 0], pushed[:, 1] = 2.0 * angle.cos(), 2.0 * angle.sin()
    swings = smooth_swings(nominal, num_worlds, STEPS, SEED, arm=0.5, rest=0.02)
    return {
        "standing": Scenario(still, nominal + 0.1 * shaking),
        "falling": Scenario(pushed, nominal + 0.25 * shaking),
        "falling, limbs only": Scenario(pushed, nominal + 0.25 * shaking, convex=False),
        LIMBS_ELLIPTIC: Scenario(pushed, nominal + 0.25 * shaking, convex=False, cone="elliptic"),
        "striking": Scenario(still, swings, strikes=True),
    }


def limbs_only(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model without the contacts of CONVEX_BODIES: their pairs become floor and table, which never touch.

    A negative margin would not work: MuJoCo's sphere and cylinder keep a contact without force, which sensors count.
    """
    geoms = [model.geom(body).id for body in CONVEX_BODIES]
    pairs = np.isin(model.pair_geom1, geoms) | np.isin(model.pair_geom2, geoms)
    model.pair_geom1[pairs], model.pair_geom2[pairs] = model.geom("floor").id, model.geom("table").id
    return model


def counting_all(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model whose sensors count all contacts of a geom, those with other parts of the robot as well."""
    touch = [index for index in range(model.nsensor) if model.sensor(index).name.endswith(TOUCH)]
    model.sensor_reftype[touch], model.sensor_refid[touch] = mujoco.mjtObj.mjOBJ_UNKNOWN, -1
    return model


def play(engine: str, nudge: float, scenario: Scenario, balls: Balls, device: str = "cpu") -> Play:
    """Roll out a scenario. ``balls``: the throws; the first rollout, which finds it empty, aims and fills it, on a
    CPU."""
    config = study_config(name=engine, cone=scenario.cone)
    count = scenario.velocity.shape[0]
    everyone = torch.ones(count, dtype=torch.bool, device=device)
    model = counting_all(model_of(config))
    if not scenario.convex:
        model = limbs_only(model)
    worlds = Worlds(config, count, device, model=model)
    qpos = standing(config, count)
    qpos[:, 7:] += nudge
    still, away = torch.zeros(count, 3, device=device), torch.full((count, 3), 50.0, device=device)
    worlds.reset_robot(everyone, qpos.to(device), scenario.velocity.to(device))
    worlds.serve(everyone, away, still, still)
    aims, seen = iter(balls), []
    first = not balls
    for step, targets in enumerate(scenario.targets):
        if scenario.strikes and step in THROWS:
            if first:
                balls.append(throw(worlds, torch.full((count,), 8.0)))
            position, velocity = balls[-1] if first else next(aims)
            worlds.serve(everyone, position.to(device), velocity.to(device), still)
        worlds.step(targets.to(device))
        seen.append(_look(worlds))
    return Play(*(np.stack(part) for part in zip(*seen, strict=True)))


def _look(worlds: Worlds) -> tuple[Array, ...]:
    robot = worlds.robot
    base = torch.cat([robot.base_position, robot.base_quat], dim=1)
    paddle = worlds.kinematics.paddle_path[:, -1]
    convex = [study_spec().contacts.index(body) for body in CONVEX_BODIES]
    touched = robot.body_contact[:, convex].amax(1)
    parts = (robot.joint_position, base, robot.foot_force[..., 2], paddle, worlds.ball.velocity, touched)
    return tuple(part.double().cpu().numpy().copy() for part in parts)


def difference(one: Play, other: Play) -> Difference:
    """Difference of two rollouts of the same scenario."""
    ahead, behind = (np.linalg.norm(one.base[..., 3:] + sign * other.base[..., 3:], axis=2) for sign in (-1, 1))
    return Difference(
        joints=np.abs(one.joints - other.joints).max(axis=2),
        base=np.linalg.norm(one.base[..., :3] - other.base[..., :3], axis=2),
        angle=4 * np.arcsin(0.5 * np.minimum(ahead, behind)),
        load=np.abs(one.load.sum(axis=2).mean(axis=0) - other.load.sum(axis=2).mean(axis=0)),
        paddle=np.linalg.norm(one.paddle[..., :3] - other.paddle[..., :3], axis=2),
        ball=np.linalg.norm(one.ball - other.ball, axis=2),
        convex=(one.touched + other.touched).max(axis=0) > 0,
    )


def compare(num_worlds: int, device: str = "cpu") -> dict[str, dict[str, Difference]]:
    """For each scenario, the difference of each of OTHERS from ``native``; ``device``: that of ``mjwarp``."""
    nominal = Worlds(study_config(), 1, "cpu").nominal
    found: dict[str, dict[str, Difference]] = {}
    for name, scenario in scenarios(num_worlds, nominal).items():
        balls: Balls = []
        native = play("native", 0.0, scenario, balls)
        found[name] = {
            other: difference(play(engine, nudge, scenario, balls, device if engine == "mjwarp" else "cpu"), native)
            for other, (engine, nudge) in OTHERS.items()
        }
    return found


def _cell(values: Array, scale: float) -> str:
    return f"{scale * np.median(values):.2g} ({scale * values.max():.2g})"


def table(found: dict[str, dict[str, Difference]]) -> str:
    """A row for each scenario and comparison: median and largest of the worlds."""
    at = [f"joints (mrad) at {20 * instant} ms" for instant in INSTANTS]
    header = ("against native", *at, "base (mm) at 1 s", "base (mrad) at 1 s", "load on the feet (N), mean of 1 s")
    rows = []
    for scenario, others in found.items():
        rows += [_row(f"{scenario}: {other}", d) for other, d in others.items()]
        d = others["mjwarp"]
        if d.convex.any() and not d.convex.all():
            apart = f"{scenario}: mjwarp, the {(~d.convex).sum()} worlds in which neither trunk nor paddle touched"
            rows.append(_row(apart, d.worlds(~d.convex)))
    return markdown(header, rows)


def _row(name: str, d: Difference) -> list[str]:
    joints = [_cell(d.joints[instant - 1], 1e3) for instant in INSTANTS]
    return [name, *joints, _cell(d.base[-1], 1e3), _cell(d.angle[-1], 1e3), _cell(d.load, 1.0)]


def strike_table(found: dict[str, dict[str, Difference]]) -> str:
    """The ball after each strike and the paddle at that time: median and largest of the worlds."""
    strikes = [f"ball (m/s) after strike {n}" for n in range(1, len(THROWS) + 1)]
    rows = []
    for other, d in found["striking"].items():
        paddle = ", ".join(_cell(d.paddle[step], 1e3) for step in THROWS)
        rows.append([other, *(_cell(d.ball[step], 1.0) for step in THROWS), paddle])
    return markdown(["against native", *strikes, "paddle (mm) then"], rows)


def draw(found: dict[str, dict[str, Difference]], figure: Figure) -> None:
    """Largest difference of the joints over the second: median of the worlds, and all of them shaded."""
    elapsed = 0.02 * np.arange(1, STEPS + 1)
    panels = figure.subplots(1, len(found), sharey=True)
    for axes, (scenario, others) in zip(panels, found.items(), strict=True):
        for (other, d), colour in zip(others.items(), COLOURS, strict=False):
            values = np.maximum(d.joints, 1e-9)
            axes.semilogy(elapsed, np.median(values, axis=1), color=colour, lw=1.5, label=other)
            axes.fill_between(elapsed, values.min(axis=1), values.max(axis=1), color=colour, alpha=0.15, lw=0)
        axes.set(xlabel="time (s)", title=scenario.replace("only, ", "only,\n"))
    panels[0].set(ylabel="largest difference of a joint to native (rad)", ylim=(1e-8, 10))
    panels[0].legend(frameon=False, fontsize=8, loc="lower right")
