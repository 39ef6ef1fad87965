"""The page of docs/results/gpu.md, a section a test: ``python -m pytest -m gpu -s tests/gpu``, or ``make gpu``.

A failed test leaves its section out, and the others go on.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from pace.bench.update import update_rates
from pace.config.base import compose, parse
from pace.config.commands import BenchConfig
from pace.runs.checkpoint_folders import list_checkpoints
from pace.runs.metrics import markdown, read_metrics
from pace.studies import parity
from tests.helpers.gpu import Sizes, captured, curve, difference_table, environment, loop_of, play, two_runs

pytestmark = pytest.mark.gpu
ROOT = Path(__file__).parents[2]
Page = Callable[[str, str], None]
#: The page evaluates by itself.
UNJUDGED = ("judge.serves=0", "judge.last_serves=0", "judge.video=0")
#: Of an evaluation: what the page does not show.
PLAIN = ("progress=false", "first_ball=[]", "task=own", "physics_dt=0.01")


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    """``python ARGUMENTS``. Errors: what it said, if it failed."""
    given = os.environ | {"PYTHONPATH": str(ROOT)}
    line = [sys.executable, *arguments]
    done = subprocess.run(line, env=given, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise AssertionError(f"{' '.join(line)}: {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")
    return done


def test_engines_agree(device: torch.device, sizes: Sizes, page: Page) -> None:
    found = parity.compare(sizes.parity_worlds, str(device))
    page(
        "Parity of the engines: mjwarp there, native on the CPU",
        parity.table(found) + "\n\n" + parity.strike_table(found),
    )
    for name in ("standing", parity.LIMBS_ELLIPTIC):
        clean = found[name]["mjwarp"].worlds(~found[name]["mjwarp"].convex)
        assert (clean.joints[:5] < 1e-4).all()  # rad, in the first 100 ms
        assert float(np.median(clean.joints[-1])) < 1e-4  # after a second; single worlds come apart by chaos


def test_graphs_and_calls(device: torch.device, sizes: Sizes, page: Page) -> None:
    seen, cost = {}, {}
    for graph in ("never", captured(device)):
        env = environment(device, sizes.worlds, graph)
        seen[graph], cost[graph] = play(env, sizes.marks)
    (calls, graphs), (slow, fast) = seen.values(), cost.values()
    text = f"A step of {sizes.worlds:,} worlds takes {fast:.2f} ms as graphs, {slow:.2f} ms as calls"
    page(
        "Graphs against calls", f"{text} ({slow / fast:.1f} times).\n\n{difference_table(sizes.worlds, calls, graphs)}"
    )
    first = min(sizes.marks)
    assert float((calls[first] - graphs[first])[:, 7:].abs().median()) < 1e-4


@pytest.mark.parametrize("fixed_order", [False, True])
def test_two_runs_of_one_seed(device: torch.device, sizes: Sizes, page: Page, fixed_order: bool) -> None:
    """``engine.deterministic`` is MuJoCo Warp's own switch; its kernels are others, and compile once more."""
    text, _ = two_runs(device, sizes.worlds, sizes.marks, fixed_order)
    page(f"Two runs of one seed, engine.deterministic={str(fixed_order).lower()}", text)


def test_killed_and_resumed(device: torch.device, sizes: Sizes, page: Page, tmp_path: Path) -> None:
    run = tmp_path / "run"
    line = [sys.executable, "-m", "pace.rl.train", f"out={run}", f"device={device}", "progress=false", "minutes=0",
            "samples=inf", "tensorboard=false", "processes=1", *UNJUDGED, *sizes.killed]  # fmt: skip
    with (tmp_path / "said").open("w") as said:
        process = subprocess.Popen(line, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=said, stderr=said)
        while process.poll() is None and len(list_checkpoints(run)) < 2:
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        process.wait()
    saved = list_checkpoints(run)
    assert saved, (tmp_path / "said").read_text()
    before = read_metrics(run / "metrics.csv")
    per_update = before["samples"][0]
    target = before["samples"][-1] + 20 * per_update
    resumed = python(
        "-m", "pace.rl.train", f"resume={run}", f"samples={target:.0f}", "progress=false", f"device={device}"
    )
    after = read_metrics(run / "metrics.csv")
    assert [int(update) for update in after["update"]] == list(range(1, len(after["update"]) + 1))
    assert all(math.isfinite(value) for value in after["kl"])
    assert after["samples"][-1] >= target
    first = next(line for line in resumed.stdout.splitlines() if "resuming" in line)
    page("Killed and resumed", f"{first}; {len(after['update'])} updates, none missing, none twice.")


def test_speed_and_memory_by_worlds(device: torch.device, sizes: Sizes, page: Page) -> None:
    head = [
        "worlds",
        "env step (ms)",
        "env steps/s",
        "loop, control steps/s",
        "update of 4 steps (ms)",
        "GPU memory (GiB)",
    ]
    rows = []
    for worlds in sizes.loop_worlds:
        rows.append(loop_of(device, worlds, sizes))
        page("Speed and memory by worlds", markdown(head, rows))


def test_the_update_beside_rsl_rl(device: torch.device, sizes: Sizes, page: Page) -> None:
    config = parse(compose("bench", [*sizes.bench, f"device={device}"]), BenchConfig)
    found = update_rates(config, device)
    rows = [[name.removesuffix("_samples_per_s"), f"{rate:,.0f}"] for name, rate in found.items()]
    page("An update of the paper's networks beside rsl_rl's", markdown(["update", "samples/s a pass"], rows))
    assert all(math.isfinite(rate) for rate in found.values())


def test_a_minute_of_training_and_its_evaluation(
    device: torch.device, sizes: Sizes, page: Page, tmp_path: Path
) -> None:
    """``PACE_GPU_RUN='minutes=10 experiment=generalist'`` is another run."""
    run, overrides = tmp_path / "run", os.environ.get("PACE_GPU_RUN", "").split() or sizes.run
    started = time.perf_counter()
    done = python(
        "-m", "pace.rl.train", f"out={run}", f"device={device}", "progress=false", "tensorboard=false", *overrides
    )
    took = time.perf_counter() - started
    said = [line for line in done.stdout.splitlines() if line.startswith(("for this", "compil", "planned"))]
    rows = curve(read_metrics(run / "metrics.csv"))
    text = f"`pace train {' '.join(overrides)}`, {took:.0f} s with imports and compilation. {'; '.join(said)}"
    page("Learning", f"{text}\n\n{rows}")
    started = time.perf_counter()
    done = python(
        "-m", "pace", "evaluate", str(run), f"device={device}", f"out={tmp_path / 'table'}", *PLAIN, *sizes.evaluated
    )
    took = time.perf_counter() - started
    table = [line for line in done.stdout.splitlines() if line and not line.startswith("wrote")]
    text = f"`pace evaluate RUN {' '.join((*PLAIN, *sizes.evaluated))}` took {took:.0f} s."
    page("Its evaluation", "\n".join([text, "", "```", *table, "```"]))
