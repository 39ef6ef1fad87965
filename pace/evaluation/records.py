"""Records of serves, one line each, and the rates that are computed from them."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pace.task.game import Outcome

#: Columns of a serve's record, m and m/s, world frame. NaN where there is none.
COLUMNS = (
    "serve_vx", "serve_vy", "serve_vz",  # at launch
    "outcome",  # pace.task.game.Outcome
    "ball",  # its number since the start of its world, from 1 on
    "hit", "rim", "fall",  # 0 or 1; fall: the robot fell, or left its area, before the serve was over
    "strike_x", "strike_y", "strike_z",  # of the paddle's contact with the ball
    "speed_out",  # of the ball after the hit
    "landing_x", "landing_y", "net_height",  # of the flight after the hit (its forecast, which is the simulation)
    "paddle_speed",  # of the point of the paddle that hit the ball, before the impact
)  # fmt: skip
C = {name: index for index, name in enumerate(COLUMNS)}
#: Failures of a serve; ``rim`` takes precedence over the outcome after it.
FAILURES = ("miss", "net", "out", "own_side", "rim", "double_hit", "volley", "body", "free_hand", "table_touch", "fall")
#: Outcomes that count as ``rim`` after a hit with the rim.
RIM_FAULTS = (Outcome.NET, Outcome.OUT, Outcome.OWN_SIDE)
Z95 = 1.959963984540054  # 97.5 % quantile of the normal distribution
#: First and last ball of each group in the table of success by the ball's number; None: no last one.
BALLS = ((1, 1), (2, 2), (3, 3), (4, 4), (5, 9), (10, 19), (20, None))


def wilson(count: int, total: int) -> tuple[float, float]:
    """95 % confidence interval of a share (E. B. Wilson 1927); NaN when nothing was counted."""
    if total == 0:
        return math.nan, math.nan
    share, square = count / total, Z95**2 / total
    centre = (share + square / 2) / (1 + square)
    half = Z95 * math.sqrt(share * (1 - share) / total + square / (4 * total)) / (1 + square)
    return max(0.0, centre - half), min(1.0, centre + half)


def rates(records: Tensor) -> dict[str, float | int]:
    """Number of ``records`` (M, columns), and the shares of them that are hits and successes, with their intervals."""
    total = records.shape[0]
    found: dict[str, float | int] = {"serves": total}
    counts = {"hit": records[:, C["hit"]] > 0, "success": records[:, C["outcome"]] == Outcome.SUCCESS}
    for name, chosen in counts.items():
        count = int(chosen.sum())
        low, high = wilson(count, total)
        found |= {name: count / max(total, 1), f"{name}_low": low, f"{name}_high": high}
    return found


def by_ball(records: Tensor) -> list[dict[str, Any]]:
    """Rates of the groups :data:`BALLS` of ``records`` (M, columns) by the ball's number; empty groups are left out.

    ``first`` and ``last`` are the smallest and the largest number in a group's records.
    """
    groups, number = [], records[:, C["ball"]]
    for first, last in BALLS:
        chosen = records[(number >= first) & (number <= (math.inf if last is None else last))]
        if len(chosen):
            ends = chosen[:, C["ball"]].aminmax()
            name = str(first) if first == last else f"{first}+" if last is None else f"{first} to {last}"
            groups.append({"balls": name, "first": int(ends.min), "last": int(ends.max), **rates(chosen)})
    return groups


def summarise(serve: str, records: Tensor, target: tuple[float, float], clear_height: float) -> dict[str, Any]:
    """Rates and means of a row from its records (M, columns).

    Shares are of the serves; ``outbound_speed`` (m/s) is a mean over hits, ``landing_error`` (m, to ``target``) and
    ``net_clearance`` (m, under the ball; ``clear_height`` m is the lowest height that passes) over successes.
    """
    hit = records[:, C["hit"]] > 0
    success = records[:, C["outcome"]] == Outcome.SUCCESS
    total = max(records.shape[0], 1)
    landing = records[success][:, [C["landing_x"], C["landing_y"]]]
    error = torch.linalg.vector_norm(landing - torch.tensor(target), dim=1)
    return {
        "serve": serve,
        **rates(records),
        "outbound_speed": _mean(records[hit][:, C["speed_out"]]),
        "landing_error": _mean(error),
        "net_clearance": _mean(records[success][:, C["net_height"]] - clear_height),
        "falls_per_1000": 1000.0 * float(records[:, C["fall"]].sum()) / total,
        "rim_hits": int((hit & (records[:, C["rim"]] > 0)).sum()),
        "failures": count_failures(records),
    }


def _mean(values: Tensor) -> float:
    """Mean without NaN."""
    return float(values[~values.isnan()].double().mean())


def count_failures(records: Tensor) -> dict[str, int]:
    """Counts of the serves without success, by the names of :data:`FAILURES`; the counts add up to them."""
    outcome, rim = records[:, C["outcome"]], records[:, C["rim"]] > 0
    by_rim = rim & sum((outcome == code for code in RIM_FAULTS), torch.zeros_like(rim))
    counts = {name: int(((outcome == Outcome[name.upper()]) & ~by_rim).sum()) for name in FAILURES if name != "rim"}
    return {name: int(by_rim.sum()) if name == "rim" else counts[name] for name in FAILURES}
