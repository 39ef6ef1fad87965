"""What the page measures. Each function takes the device, so that a CPU can try it."""

from __future__ import annotations

import gc
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from torch import Tensor

from pace.config.training import TrainConfig, load_train_config
from pace.predictor.network import make_predictor
from pace.predictor.priors import resolve_priors
from pace.rl.kernels import warm
from pace.rl.trainer import Trainer
from pace.runs.metrics import markdown
from pace.task.env import TableTennisEnv

GIB = 2**30
APART = ("control steps", "worst joint (mrad), median", "largest", "worlds within 1 mrad")


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    parity_worlds: int
    worlds: int  # of two environments that are compared
    marks: tuple[int, ...]  # control steps after which they are
    loop_worlds: tuple[int, ...]
    settle: int  # control steps before the environment is timed; updates before the loop is: a tenth
    steps: int  # that are timed
    updates: int
    network: tuple[str, ...]  # overrides
    run: tuple[str, ...]  # overrides of the training run whose curve is shown
    killed: tuple[str, ...]  # overrides of the run that is killed
    evaluated: tuple[str, ...]  # arguments of its evaluation
    bench: tuple[str, ...]  # overrides


GPU = Sizes(
    parity_worlds=64,
    worlds=1024,
    marks=(1, 10, 100, 1000),
    loop_worlds=(1024, 2048, 4096, 8192, 16384, 32768),
    settle=100,
    steps=100,
    updates=20,
    network=(),
    run=("minutes=1",),
    killed=("num_worlds=1024", "checkpoint_minutes=0.05"),
    evaluated=("serves=8000", "rows=[mixed,long]"),
    bench=("bench.parts=[update]",),
)
NETWORK = ("algo.actor_hidden=[16]", "algo.critic_hidden=[16]", "predictor.batches_per_update=2")
CPU = Sizes(
    parity_worlds=2,
    worlds=2,
    marks=(1, 4),
    loop_worlds=(2, 4),
    settle=3,
    steps=2,
    updates=1,
    network=NETWORK,
    run=("num_worlds=8", "samples=256", *NETWORK),
    killed=("num_worlds=8", "checkpoint_minutes=0.0", *NETWORK),
    evaluated=("serves=4", "rows=[mixed]", "num_worlds=2", "physics_dt=0.01"),
    bench=("bench=quick", "bench.parts=[update]", "bench.update_worlds=4"),
)


def captured(device: torch.device) -> str:
    """``engine.graph`` with which a call that cannot be captured is an error."""
    return "always" if device.type == "cuda" else "dry"


def synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def config_of(device: torch.device, worlds: int, graph: str, overrides: Sequence[str] = ()) -> TrainConfig:
    """The default configuration with a GPU's choices."""
    given = [
        f"num_worlds={worlds}", f"device={device}", "engine=mjwarp", f"engine.graph={graph}", "samples=1e9",
        "minutes=0", "algo.steps=4", "algo.minibatches=4", "tensorboard=false", "progress=false", *overrides,
    ]  # fmt: skip
    config = load_train_config(given)
    config.predictor = resolve_priors(config)
    return config


def environment(device: torch.device, worlds: int, graph: str, overrides: Sequence[str] = ()) -> TableTennisEnv:
    config = config_of(device, worlds, graph, overrides)
    torch.manual_seed(config.seed)
    return TableTennisEnv(config, worlds, device, config.seed, make_predictor(config.predictor).to(device))


def play(env: TableTennisEnv, marks: Sequence[int]) -> tuple[dict[int, Tensor], float]:
    """States (N, 7 + J) after some of the control steps under random actions, the same for the same worlds; and ms a
    step, of the second half."""
    device, shape = env.worlds.device, env.action_spec.shape
    generator, seen, last = torch.Generator(device).manual_seed(0), {}, max(marks)
    started = time.perf_counter()
    for step in range(1, last + 1):
        if step == last // 2 + 1:
            synchronise(device)
            started = time.perf_counter()
        env.advance(0.5 * torch.randn(shape, generator=generator, device=device))
        env.reset_worlds(env.terminated | env.truncated)
        if step in marks:
            seen[step] = env.worlds.engine.qpos_path[:, -1].double().cpu()
    synchronise(device)
    return seen, 1e3 * (time.perf_counter() - started) / (last - last // 2)


def apart(one: dict[int, Tensor], other: dict[int, Tensor]) -> list[list[str]]:
    """Rows: after each mark, how far the joints of two environments are apart."""
    rows = []
    for mark, state in one.items():
        worst = 1e3 * (state - other[mark])[:, 7:].abs().amax(1)
        exact = int((state == other[mark]).all(1).sum())
        median, most = float(worst.median()), float(worst.max())
        rows.append([f"{mark:,}", f"{median:.2g}", f"{most:.2g}", f"{(worst < 1).double().mean():.0%}", f"{exact}"])
    return rows


def difference_table(worlds: int, one: dict[int, Tensor], other: dict[int, Tensor]) -> str:
    """The table of :func:`apart`."""
    head = [
        "control steps",
        "worst joint (mrad), median",
        "largest",
        "worlds within 1 mrad",
        f"equal to the bit, of {worlds}",
    ]
    return markdown(head, apart(one, other))


def two_runs(device: torch.device, worlds: int, marks: Sequence[int], fixed_order: bool) -> tuple[str, float]:
    """How far two environments of one seed come apart, in words; and ms a step."""
    given = [f"engine.deterministic={str(fixed_order).lower()}"]
    warm(config_of(device, worlds, captured(device), given), device)
    played = []
    for _ in range(2):
        env = environment(device, worlds, captured(device), given)
        played.append((*play(env, marks), env.pop_statistics()))
    counts = ("; ".join(f"{float(run[name]):,.0f}" for *_, run in played) for name in ("serves", "hits", "falls"))
    counted = ", ".join(f"{name} {both}" for name, both in zip(("serves", "hits", "falls"), counts, strict=True))
    (one, _, _), (other, ms, _) = played
    text = f"A step of {worlds:,} worlds takes {ms:.2f} ms. The two runs counted: {counted}."
    return f"{text}\n\n{difference_table(worlds, one, other)}", ms


def loop_of(device: torch.device, worlds: int, sizes: Sizes) -> list[str]:
    """A row: speed of environment and training loop, and memory, with so many worlds."""
    gc.collect()
    config = config_of(device, worlds, captured(device), sizes.network)
    torch.manual_seed(config.seed)
    predictor = make_predictor(config.predictor).to(device)
    env = TableTennisEnv(config, worlds, device, config.seed, predictor)
    play(env, [sizes.settle])
    _, step_ms = play(env, [2 * sizes.steps])  # the second half is timed
    trainer = Trainer(config, env, predictor, None)
    for _ in range(max(sizes.settle // 10, 4)):
        trainer.update()
    synchronise(device)
    started = time.perf_counter()
    for _ in range(sizes.updates):
        trainer.update()
    synchronise(device)
    update = (time.perf_counter() - started) / sizes.updates
    env.warn_of_overflow()
    rates = (1e3 * worlds / step_ms, 4 * worlds / update)
    return [f"{worlds:,}", f"{step_ms:.1f}", *(f"{rate:,.0f}" for rate in rates), f"{1e3 * update:.0f}", memory(device)]


def memory(device: torch.device) -> str:
    """GiB that the card's programs hold, all together, and the parts of torch and of Warp in this process."""
    if device.type != "cuda":
        return "-"
    free, total = torch.cuda.mem_get_info(device)
    torchs, warps = torch.cuda.memory_reserved(device), wp.get_mempool_used_mem_current(wp.device_from_torch(device))
    return f"{(total - free) / GIB:.1f} (torch {torchs / GIB:.1f}, Warp {warps / GIB:.1f})"


def curve(metrics: dict[str, list[float]], points: int = 12) -> str:
    """Rates while exploring, in equal parts of a run's time."""
    columns = {name: np.array(values) for name, values in metrics.items()}
    wall = columns["wall_s"]
    rows = []
    for k in range(points):
        chosen = (wall > wall[-1] * k / points) & (wall <= wall[-1] * (k + 1) / points)
        if not chosen.any():
            continue
        part = {name: values[chosen] for name, values in columns.items()}
        serves = np.where(np.isnan(part["hit_rate"]), 0.0, part["serves"])
        total = max(serves.sum(), 1.0)
        hit, returned = (100 * np.nansum(serves * part[name]) / total for name in ("hit_rate", "success_rate"))
        falls, std = np.nanmean(part["fall_rate"]), part["policy_std"][-1]
        rows.append([f"{part['wall_s'][-1]:.0f}", f"{part['samples'][-1] / 1e6:.1f}", f"{hit:.1f}", f"{returned:.1f}",
                     f"{falls:.3f}", f"{std:.2f}"])  # fmt: skip
    return markdown(["s", "M control steps", "hit %", "return %", "falls/s", "std"], rows)
