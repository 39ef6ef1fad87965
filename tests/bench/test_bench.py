"""The benchmark: its keys, its ratios, a whole tiny run, and that what it calls MuJoCo's limit is MuJoCo's work."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from pace.bench import neighbours, physics, report, training
from pace.bench.environment import EnvironmentProcesses
from pace.bench.measure import measure
from pace.bench.physics import RawMujoco
from pace.bench.timing import median_seconds
from pace.bench.training import BenchError
from pace.bench.update import matrix_products
from pace.config.base import compose, parse
from pace.config.commands import BenchConfig
from pace.config.training import load_train_config
from pace.rl.agent import Sizes

DESIGN_KEYS = {
    "raw_mujoco_steps_per_s",
    "native_env_steps_per_s",
    "mjwarp_env_steps_per_s",
    "ppo_fp32_samples_per_s",
    "ppo_bf16_samples_per_s",
    "train_steps_per_s",
    "peak_memory_mib",
}
PENDULUM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.05"/>
    </body>
  </worldbody>
  <actuator><position joint="hinge" kp="5"/></actuator>
</mujoco>
"""
PAPER = Sizes(410, 465, 21)
TINY = ["bench=quick", "num_worlds=4", "device=cpu", "bench.update_worlds=4"]


def bench_config(*overrides: str) -> BenchConfig:
    return parse(compose("bench", [*TINY, *overrides]), BenchConfig)


@pytest.mark.long
def test_whole_quick_run_writes_every_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    path = tmp_path / "bench.json"
    figures = measure(bench_config(), ["device=cpu"], path)
    written = json.loads(path.read_text())
    assert set(report.FIGURES) <= set(written)
    assert set(report.FIGURES) >= DESIGN_KEYS
    assert {name: written[name] for name in report.FIGURES} == figures
    bf16 = {name for name in report.FIGURES if "bf16" in name}
    assert all(value is not None and value > 0 for name, value in figures.items() if name not in bf16)
    assert written["settings"] == {"num_worlds": 4, "physics_steps": 2, "repeats": 1}
    share = written["native_env_steps_per_s"] / written["raw_mujoco_steps_per_s"]
    assert written["ratios"]["native_env_steps_per_s/raw_mujoco_steps_per_s"] == pytest.approx(share)
    share = written["native_env_2x_steps_per_s"] / written["raw_mujoco_2x_steps_per_s"]
    assert written["ratios"]["native_env_2x_steps_per_s/raw_mujoco_2x_steps_per_s"] == pytest.approx(share)
    assert 100.0 < written["peak_memory_mib"] < 3 * 1024


@pytest.mark.slow
def test_parts_that_were_not_asked_for_are_null(tmp_path: Path) -> None:
    path = tmp_path / "run" / "bench.json"
    measure(bench_config("bench.parts=[physics]"), [], path)
    written = json.loads(path.read_text())
    assert {name for name in report.FIGURES if written[name] is not None} == {
        "raw_mujoco_steps_per_s",
        "native_env_steps_per_s",
        "native_env_one_process_steps_per_s",
        "raw_mujoco_2x_steps_per_s",
        "native_env_2x_steps_per_s",
        "native_env_one_process_2x_steps_per_s",
    }


def test_native_rates_are_of_n_and_of_twice_as_many_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    def rates(config: BenchConfig) -> dict[str, float]:
        return {"raw_mujoco_steps_per_s": float(config.num_worlds)}

    monkeypatch.setattr(physics, "_native_rates", rates)
    assert physics.native_rates(bench_config()) == {"raw_mujoco_steps_per_s": 4.0, "raw_mujoco_2x_steps_per_s": 8.0}


@pytest.mark.slow
def test_a_crew_plays_its_share_in_each_process_and_tells_of_one_that_failed() -> None:
    with EnvironmentProcesses(bench_config(), "native", 2) as processes:
        processes.run()
        assert [process.is_alive() for process in processes._processes] == [True, True]
        processes._processes[1].kill()
        processes._processes[1].join()
        with pytest.raises(BenchError, match="processes"):
            processes.run()
    assert not processes._processes[0].is_alive()


def test_ratios_and_table_of_known_figures() -> None:
    figures = report.complete(
        {
            "raw_mujoco_steps_per_s": 40_000.0,
            "native_env_steps_per_s": 30_000.0,
            "ppo_bf16_samples_per_s": 90_000.0,
            "rsl_rl_bf16_samples_per_s": 60_000.0,
            "train_steps_per_s": float("nan"),
        }
    )
    assert figures["train_steps_per_s"] is None
    assert report.ratios(figures) == {
        "native_env_steps_per_s/raw_mujoco_steps_per_s": 0.75,
        "ppo_bf16_samples_per_s/rsl_rl_bf16_samples_per_s": 1.5,
    }
    lines = report.table(figures).splitlines()
    assert len(lines) == 4
    assert "30,000" in lines[1]
    assert lines[1].endswith("0.75 x mj_step alone, all cores")


def test_measured_calls_take_turns_and_the_first_turn_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, calls = [0.0], []
    durations = {"a": iter([50.0, 1.0, 9.0, 2.0]), "b": iter([70.0, 4.0, 4.0, 5.0])}

    def take(name: str) -> None:
        calls.append(name)
        clock[0] += next(durations[name])

    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    measured = {"a": lambda: take("a"), "b": lambda: take("b")}
    medians = median_seconds(measured, 3, torch.device("cpu"), before=lambda: calls.append("-"))
    assert medians == {"a": 2.0, "b": 4.0}
    assert "".join(calls) == "-ab-ab-ab-ab"


def test_raw_limit_steps_every_world_as_mujoco_does() -> None:
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    starts = torch.tensor([[0.3], [-0.8], [1.2]])
    raw = RawMujoco(model, physics_steps=20)
    seen: dict[float, float] = {}
    step = mujoco.mj_step

    def spy(model: mujoco.MjModel, data: mujoco.MjData, count: int) -> None:
        start = float(data.qpos[0])
        step(model, data, count)
        seen[round(start, 6)] = float(data.qpos[0])

    raw.start_from(starts, torch.zeros(3, 1), torch.full((3, 1), 0.125))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mujoco, "mj_step", spy)
        raw.run()
    for start in starts[:, 0].double().tolist():
        data = mujoco.MjData(model)
        data.qpos[0], data.ctrl[0] = start, 0.125
        for _ in range(20):
            mujoco.mj_step(model, data)
        assert seen[round(start, 6)] == pytest.approx(data.qpos[0], abs=1e-12)
    assert len(seen) == 3


def test_matrix_products_are_those_of_one_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    config, algo = bench_config("bench.update_worlds=8"), load_train_config(["algo=paper"]).algo
    run, operations = matrix_products(config.bench.update_worlds, PAPER, algo, torch.device("cpu")), []
    multiply = torch.mm

    def counted(a: torch.Tensor, b: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        operations.append(2 * a.shape[0] * a.shape[1] * b.shape[1])
        return multiply(a, b, out=out)

    monkeypatch.setattr(torch, "mm", counted)
    run()
    layers = {"actor": [(410, 512), (512, 512), (512, 128), (128, 21)], "critic": [(465, 512), (512, 512), (512, 128)]}
    weights = sum(i * o for sizes in layers.values() for i, o in sizes) + 128
    first = 410 * 512 + 465 * 512
    assert sum(operations) == 2 * 8 * algo.steps * (3 * weights - first)


@pytest.mark.slow
def test_training_run_that_fails_says_why() -> None:
    with pytest.raises(training.BenchError, match="no_such_device"):
        training.training_run(4, 1, ["device=no_such_device"])


def test_the_ideal_loop_steps_physics_and_multiplies_matrices_one_after_the_other() -> None:
    measured = {"raw_mujoco_steps_per_s": 50_000.0, "matmul_train_samples_per_s": 200_000.0}
    found = report.ideals(measured, passes=4)
    assert found == {"train_ideal_steps_per_s": pytest.approx(1.0 / (20e-6 + 4 * 5e-6))}
    assert report.ideals({"matmul_train_samples_per_s": 1.0}, passes=4) == {}
    assert report.ratios(found | {"train_steps_per_s": 15_000.0}) == {
        "train_steps_per_s/train_ideal_steps_per_s": pytest.approx(0.6)
    }


def test_neighbours_keep_cores_busy_while_they_are_measured_and_no_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[tuple[str, ...]] = []
    seen: list[int] = []

    def measured_run(
        worlds: int, updates: int, overrides: list[str], prefix: Sequence[str] = ()
    ) -> tuple[float, float]:
        begun.append(tuple(prefix))
        seen.append(len(training._family(os.getpid())))
        return 100.0 / len(begun), 0.0

    monkeypatch.setattr(neighbours, "training_run", measured_run)
    monkeypatch.setattr(neighbours, "core_set", lambda: [3, 5])
    monkeypatch.setattr(neighbours, "_has", lambda program: True)
    rates = neighbours.neighbour_rates(bench_config(), [])
    assert [number - seen[0] for number in seen] == [0, 1, 2, 2, 0]
    assert begun == [(), (), (), ("nice", "-n", "10"), ("taskset", "-c", "3")]
    assert list(rates.values()) == [100.0, 50.0, 100.0 / 3, 25.0, 20.0]
    assert set(rates) < set(report.FIGURES)


@pytest.mark.slow
def test_a_program_may_begin_a_measured_run() -> None:
    with pytest.raises(training.BenchError, match=r"nice -n 7 .*ended with status"):
        training.training_run(4, 1, ["device=no_such_device"], ("nice", "-n", "7"))


def test_overrides_are_dropped_by_key() -> None:
    overrides = ["num_worlds=3", "algo=small_batch", "algo.gamma=0.9", "+seed=2"]
    assert training.without(overrides, "num_worlds", "algo", "seed") == ["algo.gamma=0.9"]


def test_steady_rate_leaves_the_first_updates_out(tmp_path: Path) -> None:
    rows = ["samples,wall_s", "100,10.0", "200,11.0", "300,12.5", "400,13.0"]
    metrics = tmp_path / "metrics.csv"
    metrics.write_text("\n".join(rows) + "\n")
    assert training.steady_rate(metrics) == pytest.approx((400 - 200) / (13.0 - 11.0))
    metrics.write_text("\n".join(rows[:3]) + "\n")
    assert np.isnan(training.steady_rate(metrics))
