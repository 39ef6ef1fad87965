"""Hits and returns of a policy over many serves: the rows of the paper's table II.

Each of N worlds plays without episode ends and contributes the same number of serves, whatever their outcome: a stop at
a total would favour serves that end early, which are the lost ones. The first two serves of a world are not counted
(the paper's rule). Serves after a fall are counted, because the policy caused the fall. A fall in a pause is charged to
the serve before it, whose outcome stays; a fall before a world's first serve is charged to none.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pace.evaluation.records import COLUMNS, C, summarise
from pace.predictor.network import predictor_slices
from pace.predictor.regression import BIN_NAMES, TIME_BINS
from pace.rl.policies import TaskPolicy
from pace.task.env import TableTennisEnv
from pace.task.game import Outcome

PATH_WORLDS = 6  # worlds whose base path is kept
PATH_STEPS = 400  # control steps of it, 8 s
PATIENCE = 4  # times the longest duration of the serves; beyond it serves keep missing the table
ENDLESS = ("serve.serves_per_episode=0", "serve.end_after_hit=0")  # every ball is followed to its end
STEPS_PER_LOOK = 10  # control steps between two reads of the counts: each read waits for the device

OnCount = Callable[[int], None]
#: Makes a recorder from the environment, the first serves that are not counted, and those of each world that are.
MakeRecorder = Callable[[TableTennisEnv, int, int], "ServeRecorder"]


class EvaluationError(RuntimeError):
    """An evaluation that cannot be finished; the message says why."""


class ServeRecorder:
    """Records, on the device, the outcome of each serve of an environment's worlds.

    Call :meth:`begin` after the worlds' reset, :meth:`observe` after each ``advance`` and before the reset of fallen
    worlds, :meth:`begin` again after that.

    Attributes: ``records`` (N * quota + 1, columns), world by world, the last row unused; ``early`` (N * warmup_serves
    + 1, columns), the same of the first serves, NaN if one was bad; ``counted``, ``played``, ``bad`` (N,); ``finished``
    (N,) bool, all its serves are counted and the pause after the last one is over; ``path``
    (T, W, 3) base x, y (m) and number of the serve, NaN where not filled.
    """

    def __init__(self, env: TableTennisEnv, warmup_serves: int, quota: int) -> None:
        n, device = env.num_worlds, env.worlds.device
        self.env, self.quota, self._warmup = env, quota, warmup_serves
        self.records = torch.full((n * quota + 1, len(COLUMNS)), torch.nan, device=device)
        self.early = torch.full((n * warmup_serves + 1, len(COLUMNS)), torch.nan, device=device)
        self.counted, self.played, self.bad = (torch.zeros(n, dtype=torch.long, device=device) for _ in range(3))
        self.path = torch.full((PATH_STEPS, min(n, PATH_WORLDS), 3), torch.nan, device=device)
        self._current = torch.full((n, len(COLUMNS)), torch.nan, device=device)
        worlds = torch.arange(n, device=device)
        self._first_row, self._first_early = worlds * quota, worlds * warmup_serves
        self._last_row = torch.full_like(self._first_row, n * quota)
        self.finished = torch.zeros(n, dtype=torch.bool, device=device)
        self._started = torch.ones(n, dtype=torch.bool, device=device)
        self._edges = torch.tensor(TIME_BINS, device=device)
        self._squares = torch.zeros(2, len(BIN_NAMES), device=device)
        self._apex = predictor_slices(env.config.predictor.outputs)["apex"]
        self._steps = 0

    @property
    def serves_per_world(self) -> int:
        """Serves that each world plays, if none is bad."""
        return self._warmup + self.quota

    @property
    def counting(self) -> Tensor:
        """Worlds (N,) bool whose current serve will be counted."""
        return (self.played >= self._warmup) & (self.counted < self.quota)

    def begin(self) -> None:
        """Record the launch of the serves that begin now, and the prediction before the policy's next action."""
        fresh = torch.full_like(self._current, torch.nan)
        fresh[:, :3] = self.env.worlds.ball.velocity
        fresh[:, C["hit"] : C["fall"] + 1] = 0.0
        self._current.copy_(torch.where(self._started.unsqueeze(-1), fresh, self._current))
        self._note_prediction()

    def observe(self) -> None:
        """Record the last control step."""
        self._note_hits()
        self._note_path()
        self._close(self.env.serve_over)

    def _note_hits(self) -> None:
        env = self.env
        events, returns = env.worlds.ball.events, env.game.returns
        speed = torch.linalg.vector_norm(events.hit_velocity_out, dim=1, keepdim=True)
        rim = events.hit_rim.unsqueeze(-1).float()
        hit = torch.cat((torch.ones_like(rim), rim, torch.zeros_like(rim), events.hit_point, speed), dim=1)
        paddle = events.hit_velocity_in - events.hit_relative_velocity
        paddle = torch.linalg.vector_norm(paddle, dim=1, keepdim=True)
        hit = torch.cat((hit, returns.landing[:, :2], returns.net_height.unsqueeze(-1), paddle), dim=1)
        now = env.game.referee.hit_now.unsqueeze(-1)
        columns = self._current[:, C["hit"] :]
        columns.copy_(torch.where(now, hit, columns))

    def _note_prediction(self) -> None:
        env = self.env
        error = (env.actor.prediction - env.predictor_target)[:, self._apex].square().sum(1)
        weight = (env.predictor_valid & self.counting).float()
        bins = torch.bucketize(env.predictor_time_to_apex, self._edges, right=True)
        self._squares[0].index_add_(0, bins, error * weight)
        self._squares[1].index_add_(0, bins, weight)

    def _note_path(self) -> None:
        if self._steps < PATH_STEPS:
            worlds = self.path.shape[1]
            self.path[self._steps, :, :2] = self.env.worlds.robot.base_position[:worlds, :2]
            self.path[self._steps, :, 2] = self.played[:worlds]
        self._steps += 1

    def _close(self, over: Tensor) -> None:
        env = self.env
        self._current[:, C["outcome"]] = env.serve_outcome.float()
        self._current[:, C["ball"]] = self.played + 1.0
        self._current[:, C["fall"]] = env.terminated.float()
        in_pause = env.terminated & ~over
        charged = torch.where(in_pause, self._last_row, self.records.shape[0] - 1)
        self.records[:, C["fall"]].index_fill_(0, charged, 1.0)
        bad = env.serve_outcome == Outcome.BAD_SERVE
        self._keep_early(over & ~bad & (self.played < self._warmup))
        due = over & self.counting
        kept = due & ~bad
        rows = torch.where(kept, self._first_row + self.counted, self.records.shape[0] - 1)
        self.records.index_copy_(0, rows, self._current)
        self._last_row.copy_(torch.where(over, rows, self._last_row))
        self.counted += kept
        self.bad += due & bad
        self.played += over
        self._started.copy_(env.game.ends.next_serve | env.terminated)
        pausing = env.game.pause.waiting & ~env.terminated
        self.finished |= (self.counted == self.quota) & ~pausing

    def _keep_early(self, kept: Tensor) -> None:
        rows = torch.where(kept, self._first_early + self.played, self.early.shape[0] - 1)
        self.early.index_copy_(0, rows, self._current)

    def quality(self) -> dict[str, Any]:
        """What else a recorder measured of the row; this one nothing."""
        return {}

    def predictor_errors(self) -> tuple[float, dict[str, float]]:
        """RMSE of the predicted apex (3-D, cm): over all, and by time to the apex; NaN without a predictor."""
        if self.env.actor.predictor is None:
            return math.nan, dict.fromkeys(BIN_NAMES, math.nan)
        totals = torch.cat((self._squares.sum(1, keepdim=True), self._squares), dim=1)
        overall, *by_time = (100.0 * (totals[0] / totals[1]).sqrt()).tolist()
        return overall, dict(zip(BIN_NAMES, by_time, strict=True))


@dataclass(frozen=True)
class Row:
    """One serve range: the summary for the files; every counted serve (M, columns of ``COLUMNS``), the first serves
    of each world, which are not counted, and the base paths of some worlds (T, W, 3) as in :class:`ServeRecorder`, on
    the CPU; what else its recorder measured."""

    summary: dict[str, Any]
    records: Tensor
    path: Tensor
    seconds: float  # wall-clock
    early: Tensor
    quality: dict[str, Any]

    @property
    def serve(self) -> str:
        """Name of the serve range."""
        return self.summary["serve"]

    @property
    def all_records(self) -> Tensor:
        """Every serve of the row (M, columns), the first ones of each world too."""
        return torch.cat((self.early, self.records))


def play(env: TableTennisEnv, policy: TaskPolicy, recorder: ServeRecorder, on_count: OnCount | None = None) -> None:
    """Play until every world has its serves. ``on_count`` is called with the number of all counted serves.

    Errors: :class:`EvaluationError` if serves keep missing the robot's half, or a value is not finite. A
    ``RuntimeWarning`` if the contacts exceeded the engine's memory.
    """
    total = env.num_worlds * recorder.quota
    serve = env.config.serve
    longest_s = serve.max_duration + max(serve.pause[1], serve.first_pause[1])
    longest = math.ceil(longest_s / env.worlds.control_dt) + 1
    recorder.begin()
    for step in range(1, PATIENCE * longest * recorder.serves_per_world + 1):
        env.advance(policy(env.policy_observation))
        recorder.observe()
        env.reset_worlds(env.terminated)
        recorder.begin()
        if step % STEPS_PER_LOOK == 0:
            counted, finished = torch.stack((recorder.counted.sum(), recorder.finished.sum())).tolist()
            if on_count is not None:
                on_count(counted)
            if finished == env.num_worlds:
                break
    else:
        raise EvaluationError(f"only {counted} of {total} serves were playable: the others miss the robot's half")
    bad = env.first_bad()
    if bad is not None:
        raise EvaluationError(bad)
    env.warn_of_overflow()


def evaluate_row(
    policy: TaskPolicy,
    serve: str,
    serves: int = 5000,
    num_worlds: int = 512,
    device: str = "auto",
    seed: int = 1,
    overrides: Sequence[str] = (),
    warmup_serves: int = 2,
    on_count: OnCount | None = None,
    record: MakeRecorder | None = None,
) -> Row:
    """Play at least ``serves`` serves of the range ``serve`` (a name of configs/serve/), without episode ends.

    ``overrides`` as for :func:`~pace.config.overrides.override_task`; ``record``: another recorder than
    :class:`ServeRecorder`. The same arguments, on the same device, give the same row.

    Errors: :class:`pace.config.ConfigError` for unknown names and keys.
    """
    started = time.perf_counter()
    env = policy.make_env(num_worlds, device, seed, ["reset=evaluation", f"serve={serve}", *overrides, *ENDLESS])
    recorder = (record or ServeRecorder)(env, warmup_serves, math.ceil(serves / num_worlds))
    play(env, policy, recorder, on_count)
    records = recorder.records[:-1].cpu()
    table = env.config.ball.table
    clear = table.height + table.net_height + env.config.ball.radius
    summary = summarise(serve, records, env.game.landing_target, clear)
    overall, by_time = recorder.predictor_errors()
    summary |= {
        "predictor_rmse_cm": overall,
        "predictor_rmse_cm_by_time": by_time,
        "bad_serves": int(recorder.bad.sum()),
    }
    early = recorder.early[:-1].cpu()
    early = early[~early[:, C["outcome"]].isnan()]
    quality = recorder.quality()
    return Row(summary, records, recorder.path.cpu(), time.perf_counter() - started, early, quality)
