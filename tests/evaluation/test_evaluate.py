"""Counting serves: intervals against closed forms, a scripted referee, and the command with tiny numbers."""

from __future__ import annotations

import csv
import errno
import json
import math
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from pace.command.arguments import collect_overrides, name_argument
from pace.config.base import compose, parse
from pace.config.commands import EvaluateConfig
from pace.config.overrides import override_task
from pace.evaluation import evaluate, sweep
from pace.evaluation.__main__ import main
from pace.evaluation.records import COLUMNS, C, count_failures, summarise, wilson
from pace.evaluation.report import clean, write_json
from pace.evaluation.serves import Row, ServeRecorder, evaluate_row
from pace.evaluation.sweep import Variation, ball_presets, plan_cell, plan_first_balls, variations
from pace.evaluation.text import text_table
from pace.predictor.regression import BIN_NAMES
from pace.rl.policies import built_in_policy, load_policy
from pace.runs.own_files import LIST
from pace.runs.run_folder import versions
from pace.task.game import Outcome
from tests.helpers.saved import make_config, save_run

QUICK = ["engine.physics_dt=0.02", "engine=native", "serve.max_duration=0.9"]


@pytest.mark.parametrize(
    ("count", "total", "low", "high"),
    [(0, 10, 0.0, 0.27753), (5, 10, 0.23659, 0.76341), (10, 10, 0.72247, 1.0), (941, 1000, 0.924639, 0.953986)],
)
def test_wilson_interval(count: int, total: int, low: float, high: float) -> None:
    found = wilson(count, total)
    assert found == pytest.approx((low, high), abs=1e-5)
    for bound in found:  # its defining equation: the share lies 1.96 standard errors from each bound
        distance, error = abs(count / total - bound), math.sqrt(bound * (1 - bound) / total)
        assert distance == pytest.approx(1.959964 * error, abs=1e-6)


def test_no_serves_have_no_interval() -> None:
    assert all(math.isnan(bound) for bound in wilson(0, 0))


def fake_env(worlds: int) -> SimpleNamespace:
    """What :class:`ServeRecorder` reads of an environment; the tests write into it."""
    n = worlds
    flags = {name: torch.zeros(n, dtype=torch.bool) for name in ("serve_over", "terminated", "predictor_valid")}
    events = SimpleNamespace(
        **{f"hit_{name}": torch.zeros(n, 3) for name in ("point", "velocity_out", "velocity_in", "relative_velocity")},
        hit_rim=torch.zeros(n, dtype=torch.bool),
    )
    ball = SimpleNamespace(velocity=torch.tensor([-6.0, 0.1, 1.7]).repeat(n, 1), events=events)
    robot = SimpleNamespace(base_position=torch.tensor([-1.8, 0.3, 0.7]).repeat(n, 1))
    returns = SimpleNamespace(landing=torch.full((n, 3), torch.nan), net_height=torch.full((n,), torch.nan))
    ends = SimpleNamespace(next_serve=torch.zeros(n, dtype=torch.bool))
    pause = SimpleNamespace(waiting=torch.zeros(n, dtype=torch.bool))
    referee = SimpleNamespace(hit_now=torch.zeros(n, dtype=torch.bool))
    return SimpleNamespace(
        **flags,
        num_worlds=n,
        config=make_config(),
        worlds=SimpleNamespace(device=torch.device("cpu"), ball=ball, robot=robot),
        game=SimpleNamespace(referee=referee, returns=returns, ends=ends, pause=pause),
        actor=SimpleNamespace(predictor=object(), prediction=torch.zeros(n, 7)),
        serve_outcome=torch.zeros(n, dtype=torch.int32),
        predictor_target=torch.zeros(n, 7),
        predictor_time_to_apex=torch.full((n,), 0.15),
    )


def test_a_fall_in_a_pause_is_charged_to_the_serve_before() -> None:
    env = fake_env(2)
    recorder = ServeRecorder(env, warmup_serves=0, quota=1)  # type: ignore[arg-type]
    recorder.begin()
    env.serve_outcome[:] = int(Outcome.SUCCESS)

    def step(over: bool, waiting: bool, fall: bool) -> None:
        env.serve_over.fill_(over)
        env.game.pause.waiting.fill_(waiting)
        env.terminated[1] = fall
        recorder.observe()
        recorder.begin()

    step(over=False, waiting=True, fall=True)  # before the first serve: nobody is charged
    step(over=True, waiting=True, fall=False)
    assert recorder.records[:2, C["fall"]].tolist() == [0.0, 0.0]
    assert not recorder.finished.any()  # a fall may still come
    step(over=False, waiting=True, fall=True)
    assert recorder.finished.tolist() == [False, True]
    step(over=False, waiting=False, fall=False)
    assert recorder.finished.all()
    assert recorder.records[:2, C["fall"]].tolist() == [0.0, 1.0]
    assert recorder.records[:2, C["outcome"]].tolist() == [float(Outcome.SUCCESS)] * 2
    assert recorder.counted.tolist() == [1, 1]


def test_the_recorder_keeps_what_happened_to_each_counted_serve() -> None:
    env = fake_env(2)
    recorder = ServeRecorder(env, warmup_serves=1, quota=2)  # type: ignore[arg-type]
    recorder.begin()

    def step(over: tuple[bool, bool], outcome: tuple[Outcome, Outcome], hit: bool = False, fall: bool = False) -> None:
        env.serve_over[:] = torch.tensor(over)
        env.serve_outcome[:] = torch.tensor([int(code) for code in outcome])
        env.game.referee.hit_now[:] = torch.tensor([hit, False])
        env.terminated[:] = torch.tensor([False, fall])
        env.game.ends.next_serve[:] = env.serve_over & ~env.terminated
        recorder.observe()
        recorder.begin()

    miss, open_ = Outcome.MISS, Outcome.OPEN
    step((True, True), (Outcome.SUCCESS, miss))  # warm-up: not counted
    env.worlds.ball.events.hit_point[0] = torch.tensor([-1.6, -0.2, 1.0])
    env.worlds.ball.events.hit_velocity_out[0] = torch.tensor([3.0, 0.0, 4.0])
    env.worlds.ball.events.hit_velocity_in[0] = torch.tensor([-4.0, 0.0, 0.0])
    env.worlds.ball.events.hit_relative_velocity[0] = torch.tensor([-5.5, 0.0, 2.0])
    env.game.returns.landing[0] = torch.tensor([1.0, 0.2, 0.78])
    env.game.returns.net_height[0] = 1.1
    env.predictor_valid[:] = torch.tensor([True, False])
    env.actor.prediction[0, :3] = torch.tensor([0.03, 0.0, 0.04])
    env.actor.prediction[1, :3] = 9.0  # not valid
    step((False, False), (open_, open_), hit=True)
    env.worlds.ball.events.hit_point[0] = 5.0  # a second contact, not a legal hit
    step((True, True), (Outcome.SUCCESS, Outcome.FALL), fall=True)
    step((True, True), (Outcome.BAD_SERVE, miss))
    env.worlds.ball.velocity[0] = torch.tensor([-5.3, 0.0, 1.6])
    step((True, True), (miss, miss))  # world 1 has its two serves already
    step((True, False), (miss, miss))

    early = recorder.early[:-1]
    assert early[:, C["outcome"]].tolist() == [Outcome.SUCCESS, miss]
    assert early[:, C["ball"]].tolist() == [1.0, 1.0]
    rows = recorder.records[:-1]
    assert rows[:, C["ball"]].tolist() == [2.0, 4.0, 2.0, 3.0]  # the third ball of world 0 missed the robot's half
    assert float(rows[0, C["paddle_speed"]]) == pytest.approx(2.5)
    assert recorder.counted.tolist() == [2, 2]
    assert recorder.bad.tolist() == [1, 0]
    assert rows[:, C["outcome"]].tolist() == [Outcome.SUCCESS, miss, Outcome.FALL, miss]
    assert rows[:, C["hit"]].tolist() == [1, 0, 0, 0]
    assert rows[:, C["fall"]].tolist() == [0, 0, 1, 0]
    expected = {
        "strike_x": -1.6,
        "strike_y": -0.2,
        "strike_z": 1.0,
        "speed_out": 5.0,
        "landing_x": 1.0,
        "net_height": 1.1,
    }
    for name, value in expected.items():
        assert float(rows[0, C[name]]) == pytest.approx(value)
    assert float(rows[0, C["serve_vx"]]) == -6.0
    assert bool(rows[1, C["strike_x"]].isnan())
    overall, by_time = recorder.predictor_errors()
    assert overall == pytest.approx(5.0, abs=1e-4)  # cm: 3, 0, 4
    assert by_time["0.1_0.2s"] == pytest.approx(5.0, abs=1e-4)
    assert math.isnan(by_time["over_0.4s"])


def records(outcomes: list[Outcome], rim: tuple[int, ...] = ()) -> torch.Tensor:
    """Serves with these outcomes: all but misses and falls were hit, and land at (1.15, 0.3)."""
    table = torch.zeros(len(outcomes), len(COLUMNS))
    table[:, C["outcome"]] = torch.tensor([float(code) for code in outcomes])
    table[:, C["hit"]] = torch.tensor([float(code not in (Outcome.MISS, Outcome.FALL)) for code in outcomes])
    table[list(rim), C["rim"]] = 1.0
    table[:, C["landing_x"]], table[:, C["landing_y"]] = 1.15, 0.3
    table[:, C["speed_out"]], table[:, C["net_height"]] = 6.0, 1.0
    return table


def test_failures_add_up_and_the_rim_takes_its_own() -> None:
    outcomes = [code for code in Outcome if code not in (Outcome.OPEN, Outcome.BAD_SERVE)] + [
        Outcome.OUT,
        Outcome.SUCCESS,
    ]
    counts = count_failures(records(outcomes, rim=(len(outcomes) - 2, len(outcomes) - 1)))
    assert counts == {
        "miss": 1, "net": 1, "out": 1, "own_side": 1, "rim": 1, "double_hit": 1, "volley": 1,
        "body": 1, "free_hand": 1, "table_touch": 1, "fall": 1,
    }  # fmt: skip


def test_a_row_is_the_share_of_its_serves() -> None:
    played = [Outcome.SUCCESS] * 6 + [Outcome.NET, Outcome.OUT, Outcome.MISS, Outcome.FALL]
    table = records(played)
    table[-1, C["fall"]] = 1.0
    row = summarise("mixed", table, (1.15, 0.0), clear_height=0.9)
    assert (row["serves"], row["hit"], row["success"], row["falls_per_1000"]) == (10, 0.8, 0.6, 100.0)
    assert (row["hit_low"], row["hit_high"]) == wilson(8, 10)
    assert (row["success_low"], row["success_high"]) == wilson(6, 10)
    assert row["landing_error"] == pytest.approx(0.3)
    assert row["net_clearance"] == pytest.approx(0.1)
    assert row["outbound_speed"] == pytest.approx(6.0)
    assert sum(row["failures"].values()) == 4


def test_standing_still_returns_nothing_and_a_seed_repeats() -> None:
    zero = built_in_policy("zero", 1)
    rows = [evaluate_row(zero, "short", 8, 4, "cpu", seed, QUICK, warmup_serves=1) for seed in (5, 5, 6)]
    first, again, other = (row.records for row in rows)
    assert rows[0].summary["serves"] == 8
    assert rows[0].summary["success"] == 0.0
    assert rows[0].summary["hit"] <= 0.25  # a ball may fly into a paddle that is held still
    assert sum(rows[0].summary["failures"].values()) == 8
    assert math.isnan(rows[0].summary["predictor_rmse_cm"])
    assert torch.equal(first.nan_to_num(-9), again.nan_to_num(-9))
    assert clean(rows[0].summary) == clean(rows[1].summary)
    assert not torch.equal(first[:, :3], other[:, :3])
    speeds = first[:, C["serve_vx"]]
    assert bool(((speeds >= -5.7) & (speeds <= -5.2)).all())
    assert bool(rows[0].path[:, :, :2].isfinite().any())


def test_a_saved_policy_reports_its_predictor(tmp_path: Path) -> None:
    policy = load_policy(save_run(tmp_path / "run"))
    summary = evaluate_row(policy, "long", 2, 2, "cpu", 1, QUICK, warmup_serves=0).summary
    assert 1.0 < summary["predictor_rmse_cm"] < 300.0  # untrained
    assert list(summary["predictor_rmse_cm_by_time"]) == list(BIN_NAMES)


def run_main(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["evaluate", *arguments])
    return main()


@pytest.mark.slow
def test_the_command_writes_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = save_run(tmp_path / "a run = mine"), tmp_path / "out"
    few = [f"variations.{name}=[]" for name in ("noise", "latency", "friction", "trunk_mass", "gain")]
    sweep = ["--sweep", "sweep_rows=[short]", "sweep_serves=2", "variations.ball=[venue]", "variations.engine=[native]"]
    sweep += ["reality=null"]
    small = ["rows=[mixed]", "serves=4", "num_worlds=2", "warmup_serves=0", "physics_dt=0.02", "progress=false"]
    small += ["ball=paper", "serve.max_duration=0.9", "first_ball=[0.0,0.1]", "first_ball_worlds=2"]
    assert run_main(monkeypatch, str(run), f"out={out}", "device=cpu", *small, *sweep, *few) == 0
    printed = capsys.readouterr().out
    names = {"evaluation.json", "evaluation.csv", "evaluation.md", "serves.csv", "sweep.json", "sweep.png"}
    names |= {"strike_map.png", "landing_map.png", "footwork.png", "by_ball.png"}
    assert {file.name for file in out.iterdir()} == names | {LIST}
    assert all(f"wrote {out / name}" in printed for name in names)
    assert "97.6" in printed  # the paper's hit rate stands beside ours
    page = (out / "evaluation.md").read_text()
    assert "| mixed | 4 |" in page
    assert "| ball | 1 | 2 |" in page
    assert "| 0.1 | 2 |" in page
    assert "| height of the base, cm: mean (5 to 95 %) of nominal |" in page
    check_files(out, run)


def check_files(out: Path, run: Path) -> None:
    """Keys and values of the files of a tiny evaluation."""
    content = json.loads((out / "evaluation.json").read_text())
    keys = ("serve", "serves", "hit", "hit_low", "hit_high", "success", "success_low", "success_high")
    keys += ("falls_per_1000", "predictor_rmse_cm", "failures", "outbound_speed", "landing_error", "net_clearance")
    row = content["rows"][0]
    assert set(keys) <= set(row)
    assert (row["serve"], row["serves"], sum(row["failures"].values())) == ("mixed", 4, 4)
    assert (content["ball"], content["engine"], content["seed"], content["physics_dt"]) == ("paper", "native", 1, 0.02)
    assert content["policy"].startswith(str(run))
    assert content["paper"]["mixed"] == {"serves": 88016, "hit": 0.976, "success": 0.941}
    with (out / "evaluation.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 1
    assert float(lines[0]["failures/miss"]) == row["failures"]["miss"]
    assert len((out / "serves.csv").read_text().splitlines()) == 5
    assert [group["serves"] for group in content["by_ball"]["mixed"]] == [2, 2]
    first = content["first_ball"]
    assert (first["serve"], first["ball"], [row["wait"] for row in first["rows"]]) == ("mixed", "lies", [0.0, 0.1])
    assert content["quality"]["mixed"]["height"]["nominal"] == pytest.approx(0.664583)
    assert content["quality"]["mixed"]["thresholds"]["calm_speed"] == 1.0
    cells = json.loads((out / "sweep.json").read_text())["cells"]
    assert [cell["kind"] for cell in cells] == ["as given", "ball", "engine", "first ball", "first ball"]
    assert [(row["wait"], row["serve"]) for cell in cells[3:] for row in cell["rows"]] == [
        (0.0, "short"),
        (0.1, "short"),
    ]
    assert cells[0]["rows"] == cells[2]["rows"]  # auto is native on a CPU: the same cell
    for name in ("strike_map.png", "landing_map.png", "footwork.png", "by_ball.png", "sweep.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        ((), 2, "which run"),
        (("/nowhere",), 1, "/nowhere does not exist"),
        (("policy=best",), 2, "run, zero or random"),
        (("policy=zero", "rows=[lob]"), 2, "lob"),
        (("policy=zero", "ball=wood"), 2, "wood"),
        (("policy=zero", "first_ball=[-1.0]"), 2, "first_ball must not hold negative"),
        (("policy=zero", "first_ball_kind=rolls"), 2, "carried, hidden, lies"),
        (("policy=zero", "first_ball_serve=lob"), 2, "lob"),
        (("policy=zero", "quality.calm_speed=0"), 2, "quality.calm_speed must be positive"),
        (("policy=zero", "serves=0"), 2, "serves must be at least 1"),
        (("policy=zero", "rows=[]"), 2, "at least one serve range"),
        (("policy=zero", "physics_dt=0.003"), 2, "must divide"),
        (("policy=zero", "speed=3"), 2, "speed"),
        (("policy=zero", "serve=short"), 2, "rows= names the serve ranges"),
        (("policy=zero", "task=mine"), 2, "table or own"),
        (("policy=zero", "num_worlds=0"), 2, "num_worlds must be null or at least 1"),
        (("policy=zero", "--sweep", "reality=referees"), 2, "did you mean referee?"),
    ],
)
def test_bad_input_is_one_line(
    arguments: tuple[str, ...],
    status: int,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run_main(monkeypatch, *arguments) == status
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ")
    assert message in error
    assert "\n" not in error


def test_the_sweep_changes_one_thing_at_a_time() -> None:
    task = make_config()
    cells = variations(task, parse(compose("evaluate", ["policy=zero"]), EvaluateConfig).variations)
    kinds = {kind: [cell for cell in cells if cell.kind == kind] for kind in {cell.kind for cell in cells}}
    assert [cell.value for cell in kinds["ball"]] == ball_presets() == sorted(ball_presets())
    assert {"paper", "rubber"} <= set(ball_presets())
    assert [cell.value for cell in kinds["engine"]] == ["native", "mjwarp"]
    double = override_task(task, kinds["noise"][2].overrides).sensing
    assert (double.noise_scale, double.ball_position) == ([2.0, 2.0], task.sensing.ball_position)
    assert double.mocap_delay == task.sensing.mocap_delay
    assert override_task(task, kinds["latency"][2].overrides).sensing.mocap_delay == pytest.approx([0.044, 0.05])
    bodies = task.randomization
    heavy = override_task(task, kinds["trunk_mass"][3].overrides).randomization
    assert heavy.trunk_mass == [bodies.trunk_mass[0] + 4.0, bodies.trunk_mass[1] + 4.0]
    weak = override_task(task, kinds["gain"][0].overrides).randomization
    assert weak.kp_scale == pytest.approx([0.8 * value for value in bodies.kp_scale])
    assert weak.friction == bodies.friction


SWEEP = ["--sweep", "rows=[]", "sweep_rows=[short]", "sweep_serves=2", "warmup_serves=0", "physics_dt=0.02"]
SWEEP += [
    "reality=null",
    "progress=false",
    "serve.max_duration=0.9",
    "device=cpu",
    "variations.ball=[venue]",
    "variations.engine=[]",
    "first_ball=[]",
]
SWEEP += [f"variations.{name}=[]" for name in ("noise", "latency", "friction", "trunk_mass")]


def fake_row(serves: int) -> SimpleNamespace:
    """What a sweep reads of a row."""
    return SimpleNamespace(summary=summarise("short", records([Outcome.SUCCESS] * serves), (1.15, 0.0), 0.9))


@pytest.mark.slow
def test_an_interrupted_sweep_keeps_its_cells_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    played: list[str] = []

    def play(*arguments: object) -> SimpleNamespace:
        if len(played) == 2:
            raise KeyboardInterrupt
        played.append(str(arguments[6]))
        return fake_row(2)

    monkeypatch.setattr(evaluate, "evaluate_row", play)
    same = versions()  # a commit meanwhile would be another version
    monkeypatch.setattr(evaluate, "versions", lambda: same)
    command = ["policy=zero", f"out={tmp_path}", *SWEEP, "variations.gain=[0.8,1.0,1.2]"]
    assert run_main(monkeypatch, *command) == 130
    printed = capsys.readouterr()
    assert f"rows=[] out={tmp_path}" in printed.err
    assert "2/4 | " in printed.out  # x 1 is the task as given
    assert " left | ball venue: hit/success % short 100/100 (2 serves a row)" in printed.out
    kept = json.loads((tmp_path / "sweep.json").read_text())["cells"]
    assert [cell["kind"] for cell in kept] == ["as given", "ball", "gain"]
    played[:1] = []  # one more may be played, then the next interruption
    assert run_main(monkeypatch, *command) == 130
    assert "kp_scale" in played[1]
    assert len(json.loads((tmp_path / "sweep.json").read_text())["cells"]) == 4
    capsys.readouterr()
    assert run_main(monkeypatch, *command, "seed=2") == 1  # would have other figures
    assert "give another out=" in capsys.readouterr().err
    played.pop()
    assert run_main(monkeypatch, *command) == 0
    assert run_main(monkeypatch, *command) == 0  # nothing left to play
    assert "5 cells, 0 to play" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "sweep.json").read_text())["cells"]) == 5


@pytest.mark.long
def test_a_sweep_has_the_first_balls_and_takes_those_of_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    waits: list[float] = []

    def stand(policy: object, wait: float, worlds: int, serve: str, *arguments: object) -> dict[str, object]:
        waits.append(wait)
        return {"wait": wait, **fake_row(worlds).summary, "serve": serve}

    monkeypatch.setattr(evaluate, "evaluate_row", lambda *arguments: fake_row(2))
    monkeypatch.setattr(evaluate, "first_ball_row", stand)
    same = versions()
    monkeypatch.setattr(evaluate, "versions", lambda: same)
    more = ["variations.gain=[]", "first_ball=[0.0,3.0]", "first_ball_worlds=4"]
    command = ["policy=zero", f"out={tmp_path}", *SWEEP, *more]
    assert run_main(monkeypatch, *command) == 0
    cells = json.loads((tmp_path / "sweep.json").read_text())["cells"]
    labels = [f"{cell['kind']} {cell['value']}".strip() for cell in cells]
    assert labels == ["as given", "ball venue", "first ball after 0 s", "first ball after 3 s"]
    assert [(cell["num_worlds"], cell["rows"][0]["serves"]) for cell in cells[2:]] == [(4, 4), (4, 4)]
    assert waits == [0.0, 3.0]
    assert run_main(monkeypatch, *command) == 0
    assert "4 cells, 0 to play" in capsys.readouterr().out
    assert waits == [0.0, 3.0]
    config = parse(compose("evaluate", ["policy=zero", "sweep_rows=[short]", "sweep=true", *more]), EvaluateConfig)
    planned = plan_first_balls(config, built_in_policy("zero", 1), (), {})
    rows = [{"wait": 3.0}, {"wait": 0.0}]
    known = evaluate.played_first_balls(config, planned, {"serve": "short", "rows": rows})
    assert [known[cell.key] for cell in planned] == [[{"wait": 0.0}], [{"wait": 3.0}]]
    assert evaluate.played_first_balls(config, planned, {"serve": "mixed", "rows": rows}) == {}


def test_a_file_that_is_no_sweep_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sweep.json").write_text("[1]")
    command = ["policy=zero", f"out={tmp_path}", *SWEEP, "variations.gain=[]"]
    assert run_main(monkeypatch, *command) == 2
    assert "sweep.json is no file that pace has written there" in capsys.readouterr().err
    (tmp_path / LIST).write_text("sweep.json\nsweep.png\n")  # it was one, and an editor has changed it
    assert run_main(monkeypatch, *command) == 1
    assert "sweep.json is no file of a sweep" in capsys.readouterr().err
    assert (tmp_path / "sweep.json").read_text() == "[1]"


def test_a_slow_engine_plays_fewer_serves_and_costs_more() -> None:
    config = parse(compose("evaluate", ["policy=zero", "device=cpu"]), EvaluateConfig)
    policy = built_in_policy("zero", 1)
    given, native, warp = (
        plan_cell(Variation("engine", name, (f"engine={name}",)), config, policy, (), {})
        for name in ("auto", "native", "mjwarp")
    )
    assert (native.serves, native.worlds, native.cost) == (1000, 50, 50 * 22)
    assert (warp.serves, warp.worlds, warp.cost) == (100, 5, 10 * 5 * 22)
    assert given.key == native.key != warp.key


def test_native_cells_of_a_gpu_are_played_on_its_cpu_without_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep, "resolve_device", lambda name: torch.device("cuda"))
    config = parse(compose("evaluate", ["policy=zero"]), EvaluateConfig)
    policy = built_in_policy("zero", 1)
    policy.config.engine.graph = "always"
    cell = plan_cell(Variation("engine", "native", ("engine=native",)), config, policy, (), {})
    task = override_task(policy.config, cell.overrides)
    assert (cell.device, task.engine.name, task.engine.graph) == ("cpu", "native", "auto")
    given = plan_cell(Variation("as", "given", ()), config, policy, (), {})
    assert (given.device, override_task(policy.config, given.overrides).engine.graph) == ("cuda", "always")


def test_the_run_may_stand_anywhere_and_hold_any_sign(tmp_path: Path) -> None:
    odd = tmp_path / "it's lr=1"
    odd.mkdir()
    assert name_argument(["seed=2", str(odd)], "run") == ["seed=2", "run='" + str(odd).replace("'", "\\'") + "'"]
    assert name_argument(["--cfg", "job", "serves=2"], "run") == ["--cfg", "job", "serves=2"]
    assert name_argument(["a", "b"], "run") == ["run='a'", "b"]


def test_changes_of_the_task_are_collected() -> None:
    given = ["run='a'", "ball=paper", "serves=9", "sensing.mocap_delay=[0.02,0.03]", "--cfg", "job"]
    rest = ["run='a'", "serves=9", "--cfg", "job"]
    assert collect_overrides(rest, ("ball", "sensing")) == rest
    assert collect_overrides(given, ("ball", "sensing")) == [
        *rest,
        'overrides=["ball=paper","sensing.mocap_delay=[0.02,0.03]"]',
    ]


def test_columns_line_up() -> None:
    table = text_table(("serve", "n"), [["mid_long", "7"], ["a", "1,000"]])
    assert table.splitlines() == ["serve         n", "--------  -----", "mid_long      7", "a         1,000"]


def test_an_evaluation_that_is_stopped_in_its_second_row_keeps_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played: list[str] = []

    def play(*arguments: Any, **options: Any) -> Row:
        if played:
            raise KeyboardInterrupt
        row = evaluate_row(*arguments, **options)
        played.append(row.serve)
        return row

    monkeypatch.setattr(evaluate, "evaluate_row", play)
    small = ["serves=2", "num_worlds=2", "warmup_serves=0", "physics_dt=0.02", "serve.max_duration=0.3"]
    command = ["policy=zero", "rows=[short,mixed]", f"out={tmp_path}", "progress=false", "device=cpu", *small]
    assert run_main(monkeypatch, *command) == 130
    rows = json.loads((tmp_path / "evaluation.json").read_text())["rows"]
    assert [(row["serve"], row["serves"] >= 2) for row in rows] == [("short", True)]
    assert len((tmp_path / "evaluation.csv").read_text().splitlines()) == 2
    assert [file.name for file in tmp_path.glob(".*")] == [LIST]


def test_a_full_disk_leaves_the_cells_of_a_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sweep.json").write_text('{"cells": "those that are finished"}')

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_json(tmp_path / "sweep.json", {"cells": []})
    assert json.loads((tmp_path / "sweep.json").read_text()) == {"cells": "those that are finished"}
    assert [file.name for file in tmp_path.iterdir()] == ["sweep.json"]
