"""A long evaluation: every serve is accounted for, memory and open files are flat."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from pace.evaluation.records import C, count_failures
from pace.evaluation.serves import ServeRecorder, play
from pace.rl.policies import TaskPolicy
from pace.studies.common import ENDLESS
from pace.studies.watch import Watch, require_proc
from pace.task.game import Outcome

#: Longer steps than those of an evaluation: what is looked for does not depend on them.
QUICK = ("engine.physics_dt=0.005",)


@dataclass(frozen=True)
class Account:
    """Where the serves of an evaluation went: those of the worlds' own count, by what the recorder made of them."""

    played: int
    first: int  # the first serves of the worlds, which do not count
    bad: int  # missed the robot's half
    counted: int
    beyond: int  # after a world had its number, until all worlds had theirs
    success: int
    failures: dict[str, int]
    missing: int  # in none of these, or in two


def soak(
    policy: TaskPolicy, serves: int, worlds: int, warmup: int = 2, changes: Sequence[str] = (), interval: float = 1.0
) -> tuple[Account, Watch]:
    """Play ``serves`` mixed serves in ``worlds`` worlds, and watch this process.

    Errors: :class:`pace.evaluation.serves.EvaluationError`.
    """
    require_proc()
    env = policy.make_env(worlds, "cpu", 1, [*ENDLESS, *QUICK, *changes])
    recorder = ServeRecorder(env, warmup, -(-serves // worlds))
    watch = Watch(os.getpid(), interval=interval)
    play(env, policy, recorder, lambda counted: watch.sample(float(counted)))
    return account(recorder, warmup), watch


def account(recorder: ServeRecorder, warmup: int) -> Account:
    """Where the serves of a finished recorder went.

    The numbers of the balls in the records tell which were left out: after the first serves, bad ones alone may be.
    """
    worlds, quota = recorder.env.num_worlds, recorder.quota
    records = recorder.records[:-1].cpu().view(worlds, quota, -1)
    played = recorder.env.game.clock.played.long().cpu()  # the game's count, which is not the recorder's
    bad, last = recorder.bad.cpu(), records[:, -1, C["ball"]].nan_to_num(0.0).long()
    whole = records.view(worlds * quota, -1)
    failures, success = count_failures(whole), int((whole[:, C["outcome"]] == Outcome.SUCCESS).sum())
    decided = success + sum(failures.values())
    faults = (last - warmup - quota - bad).abs() + (played - recorder.played.cpu()).abs()
    missing = int(faults.sum()) + abs(decided - worlds * quota)
    beyond = int((played - last).sum())
    return Account(int(played.sum()), warmup * worlds, int(bad.sum()), decided, beyond, success, failures, missing)


def text(found: Account) -> str:
    """The account in words."""
    failures = ", ".join(f"{name.replace('_', ' ')} {count:,}" for name, count in found.failures.items() if count)
    return (
        f"{found.played:,} serves: {found.first:,} first ones, {found.bad:,} bad, {found.counted:,} counted, "
        f"{found.beyond:,} after a world had its number. Of the counted {found.success:,} successes, {failures}; "
        f"{found.missing:,} missing"
    )
