"""Physics steps and solver settings: the same motions replayed, and their deviation from a fine simulation."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.figure import Figure

from pace.runs.metrics import markdown
from pace.sim.engine.factory import make_engine
from pace.sim.kinematics import Kinematics
from pace.studies.common import COLOURS, Array, carrying, model_of, quantiles, study_config, study_spec
from pace.studies.swings import Windows

ENGINES = ("native", "mjwarp")
STEPS = (0.001, 0.002, 0.005, 0.01)  # s
REFERENCE_DT = 0.0005  # s
REFERENCE: dict[str, object] = {
    "name": "native",
    "physics_dt": REFERENCE_DT,
    "solver_iterations": 100,
    "line_search_iterations": 50,
}
#: Control steps of a window: the paddle's motion from the decision to the hit.
LENGTH = 15
INSTANTS = (5, 15)  # control steps after the start at which errors are quoted


@dataclass(frozen=True)
class Motion:
    """Results of W windows: ``joints`` (L, W, J) rad and ``paddle`` (L, W, 12) after each control step."""

    joints: Array
    paddle: Array
    cost: float  # s of processor time for a control step of one world


@dataclass(frozen=True)
class Deviation:
    """Differences of two motions after each control step, (L, W)."""

    joints: Array  # rad, root mean square over the joints
    arm: Array  # rad, the same over waist and right arm
    paddle: Array  # m, of its centre
    speed: Array  # m/s, of its velocity


def replay(windows: Windows, engine: dict[str, object], friction_loss: float = 0.0) -> Motion:
    """Play the windows' targets from their states with the options ``engine``; no ball, no delay.

    ``friction_loss`` is a dry friction (N m) added in every joint.
    """
    config = study_config(**engine)
    model = model_of(config)
    model.dof_frictionloss[6:] += friction_loss
    count = len(windows.qpos)
    robots = make_engine(model, config.engine, count, "cpu", config.substeps)
    tips = Kinematics(model, study_spec().tips, count, config.substeps, "cpu")
    robots.reset(torch.ones(count, dtype=torch.bool), windows.qpos, windows.qvel)
    still = torch.zeros(count, model.nv)
    joints, paddle, started = [], [], 0.0
    for step, targets in enumerate(windows.targets):
        started = time.process_time() if step == 1 else started  # the first step compiles
        robots.advance(targets.unsqueeze(1).expand(-1, config.substeps, -1), still)
        tips.update(robots.qpos_path, robots.qvel_path)
        joints.append(robots.qpos_path[:, -1, 7:].double().numpy())
        paddle.append(tips.paddle_path[:, -1].double().numpy())
    cost = (time.process_time() - started) / (count * (len(windows.targets) - 1))
    return Motion(np.stack(joints), np.stack(paddle), cost)


def deviation(motion: Motion, reference: Motion) -> Deviation:
    """Deviation of ``motion`` from ``reference``."""
    joints, paddle = motion.joints - reference.joints, motion.paddle - reference.paddle
    return Deviation(
        joints=np.sqrt(np.mean(joints**2, axis=2)),
        arm=np.sqrt(np.mean(joints[..., carrying(study_spec())] ** 2, axis=2)),
        paddle=np.linalg.norm(paddle[..., :3], axis=2),
        speed=np.linalg.norm(paddle[..., 6:9], axis=2),
    )


@dataclass(frozen=True)
class Case:
    """A setting, its deviation, and its cost."""

    name: str
    deviation: Deviation
    cost: float  # s


def step_cases(windows: Windows) -> list[Case]:
    """Both engines with each of STEPS, against MuJoCo with steps of REFERENCE_DT."""
    reference = replay(windows, REFERENCE)
    cases = []
    for engine in ENGINES:
        for dt in STEPS:
            motion = replay(windows, {"name": engine, "physics_dt": dt})
            cases.append(Case(f"{engine}, {1e3 * dt:g} ms", deviation(motion, reference), motion.cost))
    elliptic = replay(windows, REFERENCE | {"cone": "elliptic"})
    name = f"native, {1e3 * REFERENCE_DT:g} ms, elliptic cone"
    return [*cases, Case(name, deviation(elliptic, reference), elliptic.cost)]


def solver_cases(windows: Windows, engines: tuple[str, ...] = ENGINES) -> list[Case]:
    """Limits of the solver, cone and dry friction: each engine against its default step solved to the end."""
    full: dict[str, object] = {"solver_iterations": 100, "line_search_iterations": 50}
    default = study_config().engine
    limits = ((2, 4), (4, 6), (6, 8), (10, 10), (default.solver_iterations, default.line_search_iterations), (20, 20))
    settings: dict[str, dict[str, object]] = {
        f"{n} and {m} iterations": {"solver_iterations": n, "line_search_iterations": m} for n, m in limits
    }
    settings |= {"elliptic cone": {"cone": "elliptic"}, "elliptic cone, solved to the end": full | {"cone": "elliptic"}}
    cases = []
    for engine in engines:
        converged = replay(windows, full | {"name": engine})
        motions = {name: replay(windows, options | {"name": engine}) for name, options in settings.items()}
        for loss in (0.1, 0.5):
            motions[f"friction loss {loss} N m"] = replay(windows, {"name": engine}, loss)
        cases += [
            Case(f"{engine}, {name}", deviation(motion, converged), motion.cost) for name, motion in motions.items()
        ]
    return cases


def table(cases: list[Case]) -> str:
    """A row for each case: errors after INSTANTS control steps as median and 95 % of the windows."""
    header = ["setting"]
    for instant in INSTANTS:
        after = f"after {20 * instant} ms"
        header += [f"arm (mrad) {after}", f"paddle (mm) {after}", f"paddle (m/s) {after}"]
    rows = []
    for case in cases:
        row = [case.name]
        for instant in INSTANTS:
            d = case.deviation
            for values, scale, digits in ((d.arm, 1e3, 2), (d.paddle, 1e3, 2), (d.speed, 1.0, 3)):
                median, high = quantiles(scale * values[instant - 1])
                row.append(f"{median:.{digits}f} ({high:.{digits}f})")
        rows.append([*row, f"{1e6 * case.cost:.0f}"])
    return markdown([*header, "cost (μs)"], rows)


def draw_steps(cases: list[Case], figure: Figure) -> None:
    """Errors of paddle and arm after each of INSTANTS against the physics step."""
    steps = 1e3 * np.array(STEPS)
    panels = {"paddle": (1e3, "paddle off by (mm)"), "speed": (1.0, "its velocity off by (m/s)")}
    panels["arm"] = (1e3, "arm's joints off by (mrad)")
    for axes, (name, (scale, label)) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        for index, (engine, colour) in enumerate(zip(ENGINES, COLOURS, strict=False)):
            own = cases[index * len(STEPS) : (index + 1) * len(STEPS)]
            for instant, style in zip(INSTANTS, ("o--", "o-"), strict=True):
                values = [np.median(scale * getattr(case.deviation, name)[instant - 1]) for case in own]
                shift = 1.0 + 0.06 * index  # else the engines' points would overlap
                title = f"{engine}, after {20 * instant} ms"
                axes.loglog(shift * steps, values, style, color=colour, lw=1.5, ms=4, label=title)
        axes.set(xlabel="physics step (ms)", ylabel=label)
        axes.set_xticks(steps, [f"{step:g}" for step in steps])
        axes.minorticks_off()
    figure.axes[0].legend(frameon=False, fontsize=8)
