"""The first ball of robots that stood ready for some time: a row of robots for each time.

Each world is reset to the evaluation's place, waits (``serve.first_pause``) and gets one ball; none is left out. A
robot that falls or leaves its area while it waits has lost its ball: it does not get another try.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from pace.config.quality import PAUSE_BALL
from pace.evaluation.records import COLUMNS, C, rates, wilson
from pace.evaluation.serves import ENDLESS, STEPS_PER_LOOK, EvaluationError, OnCount
from pace.rl.policies import TaskPolicy
from pace.task.env import TableTennisEnv
from pace.task.game import Outcome


class FirstBallRecorder:
    """Outcome of the first ball of each world of an environment, on the device.

    Attributes, (N,): ``done`` bool, the ball is over or the robot has fallen; ``waiting_fall`` bool, it fell before the
    ball was served; ``outcome`` (:class:`pace.task.game.Outcome`), ``hit`` bool.
    """

    def __init__(self, env: TableTennisEnv) -> None:
        self.env = env
        self.done, self.waiting_fall, self.hit = (torch.zeros_like(env.terminated) for _ in range(3))
        self.outcome = torch.full_like(env.serve_outcome, int(Outcome.OPEN))

    def observe(self) -> None:
        """Record the last control step: call it after ``advance`` and before the reset of fallen worlds."""
        env, fell = self.env, self.env.terminated & self.env.game.pause.waiting & ~self.done
        over = env.serve_over & ~self.done & ~fell
        self.waiting_fall |= fell
        self.hit |= over & env.serve_hit
        self.outcome.copy_(torch.where(over, env.serve_outcome, self.outcome).masked_fill(fell, int(Outcome.FALL)))
        self.done |= over | fell

    def summary(self, wait: float) -> dict[str, Any]:
        """The row of the files: rates of the balls that were playable, or not served because of a fall."""
        outcome, robots = self.outcome.cpu(), self.env.num_worlds
        records = torch.full((robots, len(COLUMNS)), torch.nan)
        records[:, C["outcome"]], records[:, C["hit"]] = outcome.float(), self.hit.cpu().float()
        falls = int(self.waiting_fall.sum())
        low, high = (1000.0 * bound for bound in wilson(falls, robots))
        found = {"wait": wait, "robots": robots, **rates(records[outcome != Outcome.BAD_SERVE])}
        every = int((outcome == Outcome.FALL).sum())
        found |= {"falls_per_1000": 1000.0 * every / robots, "falls_waiting_per_1000": 1000.0 * falls / robots}
        return found | {"falls_waiting_per_1000_low": low, "falls_waiting_per_1000_high": high}


def first_ball_row(
    policy: TaskPolicy,
    wait: float,
    worlds: int,
    serve: str = "mixed",
    kind: str = "lies",
    device: str = "auto",
    seed: int = 1,
    overrides: Sequence[str] = (),
    on_count: OnCount | None = None,
) -> dict[str, Any]:
    """Serve one ball of the range ``serve`` to each of ``worlds`` robots that stood ready for ``wait`` s.

    Until then the ball does what ``kind`` says, a key of ``serve.pause_ball``. Other arguments as those of
    :func:`pace.evaluation.serves.evaluate_row`.

    Errors: :class:`pace.config.ConfigError` for unknown names; :class:`EvaluationError` for a value that is not finite.
    """
    shares = [f"serve.pause_ball.{name}={float(name == kind)}" for name in PAUSE_BALL]
    paused = [f"serve.first_pause=[{wait},{wait}]", *shares]
    changes = ["reset=evaluation", f"serve={serve}", *overrides, *ENDLESS, *paused]
    env = policy.make_env(worlds, device, seed, changes)
    recorder = FirstBallRecorder(env)
    for step in range(math.ceil((wait + env.config.serve.max_duration) / env.worlds.control_dt) + 2):
        env.advance(policy(env.policy_observation))
        recorder.observe()
        env.reset_worlds(env.terminated)
        if step % STEPS_PER_LOOK == 0:
            done = int(recorder.done.sum())
            if on_count is not None:
                on_count(done)
            if done == worlds:
                break
    bad = env.first_bad()
    if bad is not None:
        raise EvaluationError(bad)
    return {"serve": serve, **recorder.summary(wait)}
