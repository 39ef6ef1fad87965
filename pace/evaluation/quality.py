"""Quality of play: how a robot stands, waits, moves and strikes during the serves of an evaluation.

Sums and counts over all control steps of the counted serves are kept on the device. So are two histograms: of the
base's height (bins of 1 mm) and of the time that a robot needs to calm down after a hit (bins of a control step).
Percentiles of strikes and landings are those of all counted serves. Self-contacts are sought at the end, on the CPU, in
a sample of the poses: every 10 control steps those of a block of worlds, the next block each time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pace.arrays.launch import Launch
from pace.arrays.tensors import allocate, named_tensors
from pace.config.ball import TableConfig
from pace.config.quality import QualityConfig
from pace.evaluation.quality_kernels import (
    HEIGHT_BIN,
    HEIGHT_BINS,
    QualityRules,
    QualitySums,
    QualityTrack,
    watch,
)
from pace.evaluation.records import C
from pace.evaluation.self_contacts import depths
from pace.evaluation.serves import ServeRecorder
from pace.sim.robot import joint_gains, motor_lines
from pace.task.env import TableTennisEnv
from pace.task.game import Outcome

POSE_STEPS = 10  # control steps between two samples of poses
POSE_WORLDS = 32  # worlds of a sample
#: Means of each phase over its time: name in the files -> the sum that it comes from, and its factor.
MEANS = {
    "no_foot": ("no_foot", 1.0),  # share of the time
    "base_speed": ("base_speed", 1.0),  # m/s
    "foot_slide": ("foot_slide", 1.0),  # m/s
    "lean": ("lean", 180.0 / math.pi),  # degrees
    "power": ("power", 1.0),  # W
}
PHASES = ("at_ball", "after_hit", "waiting")
ZONES = (2, 3)  # of the opponent's half along x and y


class QualityRecorder(ServeRecorder):
    """A :class:`ServeRecorder` that also measures the quality of play."""

    def __init__(self, env: TableTennisEnv, warmup_serves: int, quota: int, config: QualityConfig) -> None:
        super().__init__(env, warmup_serves, quota)
        self.config = config
        worlds, device = env.worlds, env.worlds.device
        sizes = {
            "phases": len(PHASES),
            "feet": 2,
            "joints": len(worlds.spec.joints),
            "bodies": len(worlds.spec.contacts),
        }
        self.sums = allocate(QualitySums, env.num_worlds, device, **sizes)
        self._track = allocate(QualityTrack, env.num_worlds, device, **sizes)
        longest = math.ceil(env.config.serve.max_duration / worlds.control_dt)
        self.heights = torch.zeros(HEIGHT_BINS, dtype=torch.int32, device=device)
        self.calms = torch.zeros(longest + 3, dtype=torch.int32, device=device)
        self._poses: list[Tensor] = []
        self._looks = 0
        self._watch = self._record_launch()

    def _record_launch(self) -> Launch:
        env, engine, state = self.env, self.env.worlds.engine, self.env.task_state
        seen = {"robot": env.worlds.robot, "game": env.game, "qvel": engine.qvel_path}
        seen |= {"effort_scale": engine.params.effort_scale, "played": self.played, "counted": self.counted}
        seen |= {"foot_contact": state.foot_contact, "foot_slide": state.measures["foot_slide"]}
        kept = {"sums": self.sums, "track": self._track, "heights": self.heights, "calms": self.calms}
        given = {"limits": self._limits(), "rules": self._rules()}
        return Launch(watch, env.num_worlds, env.worlds.device, **seen, **kept, **given)

    def _limits(self) -> dict[str, Tensor]:
        worlds, robot = self.env.worlds, self.env.config.robot
        margin = self.config.range_end * (worlds.joint_upper - worlds.joint_lower)
        effort, lines = joint_gains(robot)[2], motor_lines(robot)
        speed, stall = (np.ones_like(effort), np.zeros_like(effort)) if lines is None else lines
        motors = {"effort": effort, "stall": stall, "speed": speed}
        limits = {name: torch.as_tensor(row, dtype=torch.float32).to(worlds.device) for name, row in motors.items()}
        return limits | {"low": worlds.joint_lower + margin, "high": worlds.joint_upper - margin}

    def _rules(self) -> QualityRules:
        rules, dt = QualityRules(), self.env.worlds.control_dt
        rules.warmup, rules.quota = self._warmup, self.quota
        rules.window = max(1, round(self.config.sway_window / dt))
        rules.after_hit = round(self.config.after_hit / dt)
        rules.calm_square, rules.slack = self.config.calm_speed**2, self.config.torque_slack
        return rules

    def observe(self) -> None:
        """See :meth:`ServeRecorder.observe`."""
        self._watch()
        if self._looks % POSE_STEPS == 0:
            self._sample_poses(self._looks // POSE_STEPS)
        self._looks += 1
        super().observe()

    def _sample_poses(self, number: int) -> None:
        """Keep the poses of the next block of worlds, with whether their serve is counted in the last column."""
        first = number * POSE_WORLDS % self.env.num_worlds
        block = slice(first, first + POSE_WORLDS)
        counted = self.counting[block].unsqueeze(1).float()
        self._poses.append(torch.cat((self.env.worlds.robot.joint_position[block], counted), dim=1))

    def poses(self) -> Tensor:
        """At most ``config.poses`` of the sampled poses (P, J), rad, evenly spread over the row, on the CPU."""
        sampled = torch.cat(self._poses).cpu()
        counted = sampled[sampled[:, -1] > 0, :-1]
        return counted[:: max(1, math.ceil(len(counted) / self.config.poses))]

    def quality(self) -> dict[str, Any]:
        """Quality of play, by measure, in m, s, rad/s, W, degrees (lean) and shares of the time."""
        totals = {name: tensor.double().sum(0).cpu() for name, tensor in named_tensors(self.sums).items()}
        worlds, instants = self.env.worlds, totals["instants"].sum()
        records = self.records[:-1].cpu()
        table = self.env.config.ball.table
        clear = table.height + table.net_height + self.env.config.ball.radius
        shares = {name: (totals[name] / instants).tolist() for name in ("range_end", "torque_limit", "touches")}
        return {
            "height": self._heights(float(totals["height"] / instants)),
            **self._phases(totals),
            "sway": float((totals["sway"] / totals["windows"]).sqrt()),
            "calm_after_hit": calm(self.calms.cpu(), worlds.control_dt),
            "range_end": dict(zip(worlds.spec.joints, shares["range_end"], strict=True)),
            "torque_limit": dict(zip(worlds.spec.joints, shares["torque_limit"], strict=True)),
            "touches": dict(zip(worlds.spec.contacts, shares["touches"], strict=True)),
            "self_contacts": self._self_contacts(),
            **strikes(records, clear),
            "landing": landing(records, table, self.config.edge),
            "thresholds": vars(self.config),
        }

    def _heights(self, mean: float) -> dict[str, float]:
        found = {"mean": mean, "nominal": float(self.env.worlds.model.key_qpos[0, 2])}
        counts = self.heights.cpu()
        return found | {f"p{share}": HEIGHT_BIN * quantile(counts, share / 100) for share in (5, 95)}

    def _phases(self, totals: Mapping[str, Tensor]) -> dict[str, dict[str, float]]:
        instants = totals["instants"]
        means = {name: factor * totals[of] / instants for name, (of, factor) in MEANS.items()}
        means["share"] = instants / instants.sum()
        means["feet_lifted"] = totals["lifted"] / instants / self.env.worlds.control_dt
        means["joint_speed"] = (totals["joint_square"] / instants).sqrt()
        return {phase: {name: float(pair[i]) for name, pair in means.items()} for i, phase in enumerate(PHASES)}

    def _self_contacts(self) -> dict[str, dict[str, float]]:
        """Share of the sampled poses, and greatest depth, m, of each pair of parts that meets."""
        poses = self.poses().double().numpy()
        found = depths(self.env.worlds.model, self.env.worlds.spec, poses)
        rows = {name: {"share": float((deep > 0).mean()), "deepest": float(deep.max())} for name, deep in found.items()}
        return dict(sorted(rows.items(), key=lambda row: -row[1]["share"]))


def quantile(counts: Tensor, share: float) -> float:
    """Quantile of a histogram (B,) in bins, linear within a bin; NaN for an empty one."""
    sums = counts.double().cumsum(0)
    wanted = share * float(sums[-1])
    if wanted <= 0.0:
        return math.nan
    place = int(torch.searchsorted(sums, wanted))
    return place + 1.0 - (float(sums[place]) - wanted) / float(counts[place])


def calm(counts: Tensor, control_dt: float) -> dict[str, float]:
    """Time (s) from a hit until the robot stays calm, median and 95 %; share of hits after which it did not.

    ``counts``: hits by control steps; the last number those after which it did not, which count as the longest times.
    """
    total = float(counts.sum())
    found = {}
    for share in (50, 95):
        place = int(torch.searchsorted(counts.double().cumsum(0), share / 100 * total)) if total else len(counts)
        found[f"p{share}"] = control_dt * place if place < len(counts) - 1 else math.nan
    return found | {"never": float(counts[-1]) / total if total else math.nan}


def spread(values: Tensor) -> dict[str, float]:
    """Median and the range of 90 % of ``values``, without NaN."""
    known = values[~values.isnan()].double()
    ends = torch.tensor([0.05, 0.5, 0.95], dtype=torch.double)
    low, middle, high = known.quantile(ends).tolist() if len(known) else [math.nan] * 3
    return {"p5": low, "p50": middle, "p95": high}


def strikes(records: Tensor, clear_height: float) -> dict[str, dict[str, float]]:
    """Speeds at the hits of ``records`` (M, columns), m/s; air between net and ball of the successes, m."""
    hits = records[records[:, C["hit"]] > 0]
    successes = records[records[:, C["outcome"]] == Outcome.SUCCESS]
    speeds = {name: spread(hits[:, C[name]]) for name in ("paddle_speed", "speed_out")}
    return speeds | {"net_clearance": spread(successes[:, C["net_height"]] - clear_height)}


def landing(records: Tensor, table: TableConfig, edge: float) -> dict[str, Any]:
    """Where the successes of ``records`` (M, columns) land: mean and standard deviation of x and y (m), the share that
    lands closer than ``edge`` m to an end or side line, and the shares of the six zones of the half.

    ``zones``: from the net to the end line, each from the robot's right to its left (growing y).
    """
    points = records[records[:, C["outcome"]] == Outcome.SUCCESS][:, [C["landing_x"], C["landing_y"]]].double()
    if len(points) < 2:
        return {}
    half = torch.tensor([0.5 * table.length, 0.5 * table.width], dtype=torch.double)
    near = ((half - points.abs()) < edge).any(1)
    (mean_x, mean_y), (std_x, std_y) = points.mean(0).tolist(), points.std(0).tolist()
    zones = zone_counts(points / half)
    found = {"x": mean_x, "y": mean_y, "std_x": std_x, "std_y": std_y, "near_edge": float(near.double().mean())}
    return found | {"zones": [[count / len(points) for count in row] for row in zones]}


def zone_counts(places: Tensor) -> Sequence[Sequence[int]]:
    """Numbers of ``places`` (M, 2), x from 0 at the net to 1 at the end line and y from -1 to 1, in each zone."""
    deep, wide = ZONES
    rows = (deep * places[:, 0]).long().clamp(0, deep - 1)
    columns = (wide * (0.5 * places[:, 1] + 0.5)).long().clamp(0, wide - 1)
    return torch.bincount(wide * rows + columns, minlength=deep * wide).view(deep, wide).tolist()
