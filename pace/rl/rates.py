"""Rates of a rollout, from the sums over the worlds."""

from __future__ import annotations

import math
from collections.abc import Mapping

COUNTS = ("serves", "hits", "successes", "falls", "episodes", "steps", "reward_sum", "diverged")


def rates(sums: Mapping[str, float], control_dt: float) -> dict[str, float]:
    """Rates of the last rollout from the sums over all worlds, of all processes; NaN if nothing was counted.

    ``hit_rate`` and ``success_rate`` are shares of the serves that ended, ``fall_rate`` is falls per second of a
    world's time, rewards are means per control step, and every other sum is given per serve.
    """

    def share(name: str, of: str) -> float:
        return sums[name] / sums[of] if sums[of] > 0 else math.nan

    row = {
        "hit_rate": share("hits", "serves"),
        "success_rate": share("successes", "serves"),
        "fall_rate": share("falls", "steps") / control_dt,
        "mean_reward": share("reward_sum", "steps"),
        "episodes": sums["episodes"],
        "serves": sums["serves"],
        "diverged": sums.get("diverged", 0.0),
    }
    for name in sums:
        if name.startswith("reward/"):
            row[name] = share(name, "steps")
        elif name not in COUNTS:
            row[name] = share(name, "serves")
    return row
