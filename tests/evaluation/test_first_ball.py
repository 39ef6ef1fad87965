"""The first ball after standing ready: a scripted referee, the same balls as those of a row, and robots that wait."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from pace.evaluation.first_ball import FirstBallRecorder, first_ball_row
from pace.evaluation.records import wilson
from pace.evaluation.serves import evaluate_row
from pace.rl.policies import built_in_policy
from pace.task.game import Outcome

QUICK = ["engine.physics_dt=0.02", "engine=native", "engine.threads=1", "serve.max_duration=0.9"]


def test_a_fall_while_waiting_loses_the_ball_and_there_is_no_other_try() -> None:
    flags = {name: torch.zeros(4, dtype=torch.bool) for name in ("terminated", "serve_over", "serve_hit")}
    pause = SimpleNamespace(waiting=torch.ones(4, dtype=torch.bool))
    outcome = torch.full((4,), int(Outcome.BAD_SERVE), dtype=torch.int32)
    env = SimpleNamespace(**flags, serve_outcome=outcome, num_worlds=4, game=SimpleNamespace(pause=pause))
    recorder = FirstBallRecorder(env)  # type: ignore[arg-type]
    env.terminated[0] = True
    recorder.observe()  # robot 0 falls in the pause, begins another one and gets a ball
    env.terminated[0], pause.waiting[:] = False, False
    env.serve_over[:] = torch.tensor([True, True, True, False])
    env.serve_hit[:] = torch.tensor([True, True, False, False])
    outcome[:3] = torch.tensor([Outcome.SUCCESS, Outcome.SUCCESS, Outcome.BAD_SERVE], dtype=torch.int32)
    recorder.observe()
    env.serve_over[:], env.serve_hit[:], env.terminated[3] = False, False, True
    env.serve_over[3], outcome[3] = True, int(Outcome.FALL)  # at the ball: no fall while waiting
    recorder.observe()
    env.serve_over[1], outcome[1] = True, int(Outcome.OUT)  # the second ball of robot 1
    recorder.observe()
    assert recorder.done.all()
    found = recorder.summary(3.0)
    assert (found["wait"], found["robots"], found["serves"]) == (3.0, 4, 3)  # the ball of robot 2 was unplayable
    assert (found["hit"], found["success"]) == pytest.approx((1 / 3, 1 / 3))
    assert found["falls_waiting_per_1000"] == 250.0
    bounds = found["falls_waiting_per_1000_low"], found["falls_waiting_per_1000_high"]
    assert bounds == pytest.approx(tuple(1000.0 * bound for bound in wilson(1, 4)))


def test_without_a_wait_it_is_the_first_ball_of_a_row() -> None:
    policy = built_in_policy("random", 3)
    found = first_ball_row(policy, 0.0, 16, "mixed", "lies", "cpu", 5, QUICK)
    policy = built_in_policy("random", 3)
    row = evaluate_row(policy, "mixed", 16, 16, "cpu", 5, QUICK, warmup_serves=0).summary
    assert {name: found[name] for name in ("serves", "hit", "success")} == {
        name: row[name] for name in ("serves", "hit", "success")
    }
    assert found["falls_waiting_per_1000"] == 0.0


def test_robots_that_cannot_stand_fall_while_they_wait() -> None:
    counts: list[int] = []
    limp = [*QUICK, "randomization.kp_scale=[0.0,0.0]"]
    found = first_ball_row(built_in_policy("zero", 1), 3.0, 4, "mixed", "hidden", "cpu", 1, limp, counts.append)
    assert (found["hit"], found["success"], found["falls_waiting_per_1000"]) == (0.0, 0.0, 1000.0)
    assert counts[-1] == 4
    assert len(counts) < 16  # it ends once all are down: 3 s would be 16 looks
