"""The ball against independent solutions: the figures and numbers of ``docs/results/physics.md``."""

from __future__ import annotations

import time
from dataclasses import fields

import numpy as np
import torch
import warp as wp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from omegaconf import DictConfig
from torch import Tensor

from pace.arrays.launch import Launch
from pace.config.base import parse
from pace.config.commands import ValidateConfig
from pace.runs.run_folder import make_out
from pace.sim.ball.ball import BallParams, BallSim, Forecast, ball_preset
from pace.sim.ball.rebound import Material, rebound
from pace.studies import ball_reference as reference
from pace.studies.ball_strikes import frame_difference, phase_spread
from pace.studies.ball_trials import (
    BALL_DT,
    BALLS,
    PRESETS,
    fitted_drag,
    forecast_errors,
    make_sim,
    put,
    recorded_flights,
    true_drag,
)
from pace.studies.common import COLOURS, save_figure

SERVE = ([1.35, 0.0, 1.03], [-5.75, 0.0, 1.75])
RETURN = ([-1.6, 0.0, 1.0], [5.5, 0.0, 2.2])


def resting_path(num_worlds: int, centre: tuple[float, float, float]) -> Tensor:
    """A paddle (N, 3, 12) that stands still and faces the opponent."""
    path = torch.zeros(num_worlds, 3, 12)
    path[:, :, :3] = torch.tensor(centre)
    path[:, :, 3] = 1.0
    return path


def forecast_serves(serves: reference.ServeBatch, ball_dt: float) -> Forecast:
    """The forecast of the reference's serves."""
    given = {f.name: torch.tensor(getattr(serves.ball, f.name)) for f in fields(serves.ball)}
    params = BallParams(**given, paddle_restitution=0.8, paddle_restitution_slope=0.0, paddle_friction=0.3)
    count = len(serves.position)
    sim = make_sim(count, params, ball_dt=ball_dt)
    start = [torch.tensor(a, dtype=torch.float32) for a in (serves.position, serves.velocity, serves.spin)]
    sim.forecast(torch.ones(count, dtype=torch.bool), start[0], start[1], start[2], -1.6)
    return sim.forecast_result


def flight_errors(serves: reference.ServeBatch, ball_dt: float) -> dict[str, NDArray[np.float64]]:
    """Errors (N,) against the reference: positions in um, times in us."""
    forecast, flight = forecast_serves(serves, ball_dt), serves.flight
    return {
        "bounce position": 1e6 * np.linalg.norm(forecast.bounce.numpy() - flight.bounce, axis=1),
        "apex position": 1e6 * np.linalg.norm(forecast.apex.numpy() - flight.apex, axis=1),
        "bounce time": 1e6 * np.abs(forecast.bounce_time.numpy() - flight.bounce_time),
        "apex time": 1e6 * np.abs(forecast.apex_time.numpy() - flight.apex_time),
    }


def draw_flight_errors(figure: Figure) -> None:
    """Left: errors of 1,000 serves; right: the largest one against the longest sub-step."""
    serves = reference.random_serves(1000)
    errors = flight_errors(serves, BALL_DT)
    left, right = figure.subplots(1, 2)
    bins = np.geomspace(1e-2, 1e3, 41)
    for (name, values), colour in zip(errors.items(), COLOURS, strict=False):
        unit = "μs" if name.endswith("time") else "μm"
        left.hist(np.maximum(values, bins[0]), bins, histtype="step", color=colour, label=f"{name} ({unit})", lw=1.5)
        print(f"{name}: median {np.median(values):.2f}, largest {values.max():.1f} {unit}")
    left.axvline(500, color="0.5", ls=":", lw=1)
    left.text(430, left.get_ylim()[1], "asked for:\n500 μs, 1000 μm ", ha="right", va="top", fontsize=8, color="0.4")
    left.set(xscale="log", xlabel="error against DOP853", ylabel="serves of 1,000")
    left.legend(frameon=False, fontsize=8, loc="center right")
    steps = np.array([0.25, 0.5, 1, 2, 4, 10, 20, 40])
    largest = [flight_errors(serves, 1e-3 * step) for step in steps]
    for name, colour in zip(errors, COLOURS, strict=False):
        right.loglog(steps, [e[name].max() for e in largest], "o-", color=colour, lw=1.5, ms=4)
    right.axvline(1e3 * BALL_DT, color="0.5", ls=":", lw=1)
    right.set(xlabel="longest sub-step, ball_dt (ms)", ylabel="largest error (μm, μs)", ylim=(0.3, 1000))


@wp.kernel
def _strike(
    slip: wp.array[wp.float32],
    friction: float,
    back: float,
    velocity: wp.array[wp.vec3],
    spin: wp.array[wp.vec3],
):
    """Rebound of a ball without spin at 1 m/s downwards and ``slip`` m/s along x, with e = 0.8, e_t = ``back``."""
    i = wp.tid()
    material = Material()
    material.restitution = 0.8
    material.friction = friction
    material.tangential = back
    zero = wp.vec3(0.0, 0.0, 0.0)
    after, after_spin = rebound(wp.vec3(slip[i], 0.0, -1.0), zero, wp.vec3(0.0, 0.0, 1.0), zero, 0.02, material)
    velocity[i] = after
    spin[i] = after_spin


def draw_rebound(figure: Figure) -> None:
    """Share of the tangential speed left after a rebound, and the spin that it gives: kernel (dots) and closed form."""
    slip = np.linspace(0.05, 8.0, 60)
    kept, turned = figure.subplots(1, 2)
    surfaces = ((0.1, 0.0), (0.25, 0.0), (0.6, 0.0), (0.6, 0.82), (1.1, 0.82))  # the last: measured rubber
    for (friction, back), colour in zip(surfaces, COLOURS, strict=False):
        velocity, spin = torch.zeros(2, len(slip), 3)
        given = {"slip": torch.tensor(slip, dtype=torch.float32), "friction": friction, "back": back}
        Launch(_strike, len(slip), torch.device("cpu"), velocity=velocity, spin=spin, **given)()
        loss = np.minimum(0.4 * (1.0 + back) * slip, friction * 1.8)
        kept.plot(slip, 1 - loss / slip, color=colour, lw=1.5, label=f"μ = {friction}, $e_t$ = {back}")
        kept.plot(slip[::4], velocity.numpy()[::4, 0] / slip[::4], "o", color=colour, ms=4)
        turned.plot(slip, 1.5 * loss / 0.02, color=colour, lw=1.5)
        turned.plot(slip[::4], spin.numpy()[::4, 1], "o", color=colour, ms=4)
    kept.set(xlabel="slip over normal speed, $|u| / |v_n|$", ylabel="share of the tangential speed kept", ylim=(0, 1))
    kept.legend(frameon=False, loc="lower right")
    kept.text(0.1, 0.63, "rolls: 3/5", fontsize=8, color="0.3")
    kept.text(0.1, 0.21, "springs back: 1 - 2/5 (1 + $e_t$)", fontsize=8, color="0.3")
    turned.set(xlabel="slip over normal speed, $|u| / |v_n|$", ylabel="spin after, at $|v_n|$ = 1 m/s (rad/s)")


def trajectory(preset: str, position: list[float], velocity: list[float]) -> NDArray[np.float64]:
    """Positions (T, 3) of a flight without a paddle until it is near the floor, every 10 ms."""
    sim = BallSim(1, "cpu", BallParams.preset(preset), ball_preset(preset).table, 0.01, 2, BALL_DT)
    put(sim, position, velocity)
    path, seen = resting_path(1, (0.0, 0.0, 50.0)), [sim.position[0].numpy().copy()]
    while seen[-1][2] > 0.05 and len(seen) < 200:
        sim.fly(path)
        seen.append(sim.position[0].numpy().copy())
    return np.array(seen)


def draw_flights(axes: Axes, start: tuple[list[float], list[float]], title: str) -> None:
    """One flight from the side, with each preset."""
    table = ball_preset("paper").table
    axes.plot([-table.length / 2, table.length / 2], [table.height] * 2, color="0.3", lw=3)
    axes.plot([0, 0], [table.height, table.height + table.net_height], color="0.3", lw=1.5)
    for preset, colour in zip(BALLS, COLOURS, strict=False):
        way = trajectory(preset, *start)
        axes.plot(way[:, 0], way[:, 2], color=colour, lw=1.5, label=preset)
    axes.set(xlabel="x (m)", ylabel="z (m)", title=title, ylim=(0, 1.6), aspect="equal")


def draw_presets(figure: Figure) -> None:
    """The same serve and the same return in all presets."""
    serve, back = figure.subplots(2, 1)
    draw_flights(serve, SERVE, "serve at 6.0 m/s")
    draw_flights(back, RETURN, "return at 5.9 m/s")
    serve.set_xlim(-3.6, 1.6)
    back.set_xlim(-1.8, 3.4)
    serve.legend(frameon=False, fontsize=8, loc="lower right")


def print_presets() -> None:
    """A table of one serve, and of a ball that hits a resting paddle at 5 m/s, with each preset."""
    print("\npreset: bounce time (s), bounce x, apex x, apex z (m), apex time (s); speed off a resting paddle (m/s)")
    for preset in PRESETS:
        sim = make_sim(1, BallParams.preset(preset))
        put(sim, *SERVE)
        sim.forecast(torch.ones(1, dtype=torch.bool), sim.position, sim.velocity, sim.spin, -1.6)
        ahead = sim.forecast_result
        put(sim, [-1.55, 0.0, 3.0], [-5.0, 0.0, 0.0])
        sim.fly(resting_path(1, (-1.6, 0.0, 3.0)))
        values = [ahead.bounce_time, ahead.bounce[:, 0], ahead.apex[:, 0], ahead.apex[:, 2], ahead.apex_time]
        out = sim.events.hit_velocity_out[0, 0]
        print(f"{preset}: " + ", ".join(f"{float(v):.3f}" for v in values) + f"; {float(out):.2f}")


def print_checks() -> None:
    """Strikes in other frames and phases, identified drag, and the forecast compared with the flight."""
    print("\nstrikes by a swinging paddle seen from another frame: change of the velocity over the speed; of the spin")
    for velocity, yaw in (((5.0, -3.0, 4.0), 0.0), ((0.0, 0.0, 0.0), 1.1), ((-9.0, 6.0, 0.0), -2.0)):
        share, spin = frame_difference(velocity, yaw)
        print(f"moving at {velocity} m/s, turned by {yaw} rad: {share:.1e}, {spin:.2f} rad/s")
    print("100 strikes, each at 20 phases of a control step: largest range of the velocity over the speed; of the spin")
    for substeps in (2, 4, 10):
        share, spin = phase_spread(substeps)
        largest, median = share.max(), np.median(share)
        print(f"path known every {20 / substeps:g} ms: {largest:.1e} (median {median:.1e}), {spin.max():.2f} rad/s")
    print("drag identified from 22 flights of 20 frames (paper's ball)")
    for noise in (0.0, 0.001):
        error = fitted_drag(recorded_flights(22, 20, noise)) / true_drag("paper") - 1
        print(f"noise {1e3 * noise:g} mm: k off by {100 * error:+.3f} %")
    print("forecast against flight, 300 returns: largest error of the landing's time and position")
    for preset in PRESETS:
        times, places = forecast_errors(preset)
        print(f"{preset}: {1e6 * times.max():.0f} μs, {1e3 * places.max():.3f} mm")


def print_speed(num_worlds: int = 1024) -> None:
    """The least of several timings of a control step over a serve, and of a forecast in all worlds."""
    params = BallParams.preset("rubber")
    sim, path = make_sim(num_worlds, params), resting_path(num_worlds, (-1.7, 0.0, 1.05))
    steps, repeats = 50, 10
    velocity = np.array(SERVE[1]) + np.random.default_rng(0).uniform(-0.2, 0.2, (num_worlds, 3))
    best, ahead, everyone = np.full(steps, np.inf), np.inf, torch.ones(num_worlds, dtype=torch.bool)
    for _ in range(repeats):
        put(sim, SERVE[0], velocity)
        begun = time.perf_counter()
        sim.forecast(everyone, sim.position, sim.velocity, sim.spin, -1.6)
        ahead = min(ahead, time.perf_counter() - begun)
        for step in range(steps):
            begun = time.perf_counter()
            sim.fly(path)
            best[step] = min(best[step], time.perf_counter() - begun)
    begun = time.perf_counter()
    for _ in range(100):
        sim.forecast(~everyone, sim.position, sim.velocity, sim.spin, -1.6)
    idle = (time.perf_counter() - begun) / 100
    print(f"\n{num_worlds} worlds, Warp's CPU device (one thread), ball_dt {1e3 * BALL_DT:g} ms:")
    print(f"fly: mean {1e3 * best.mean():.2f} ms a control step, slowest {1e3 * best.max():.2f} ms")
    each = 1e6 * ahead / num_worlds
    print(f"forecast: {1e3 * ahead:.1f} ms for all worlds ({each:.1f} μs each), {1e3 * idle:.3f} ms for none")


def validate_from_config(composed: DictConfig) -> None:
    """Draw the figures into the configured folder, and print the numbers."""
    config = parse(composed, ValidateConfig)
    figures = {"flight_error.png": draw_flight_errors, "rebound.png": draw_rebound, "presets.png": draw_presets}
    out = make_out(config.out, "validate", list(figures))
    for name, draw in figures.items():
        save_figure(out / name, (7.5, 5.4) if draw is draw_presets else (9, 3.4), draw)
    print_presets()
    print_checks()
    print_speed()
