"""The judgements of a training run: a quick one after each checkpoint, and the table and figures at its end."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from pace.config.base import ConfigError, compose, parse
from pace.config.commands import EvaluateConfig, PaperRow
from pace.config.judge import JudgeConfig
from pace.evaluation.evaluate import circumstances
from pace.evaluation.figures import FIGURES, write_figures
from pace.evaluation.report import FILES as REPORT
from pace.evaluation.report import write_report
from pace.evaluation.serves import EvaluationError, Row, evaluate_row
from pace.evaluation.task import policy_on, task_line
from pace.evaluation.text import interval, number, text_table
from pace.rl.policies import load_policy
from pace.runs.files import say, tell
from pace.runs.own_files import make_out
from pace.runs.run_folder import EVALUATION

DEVICE = "cpu"  # a GPU's memory belongs to the run
SEED = 1  # as that of pace evaluate


class RunJudge:
    """See :class:`pace.rl.judge.Judge`."""

    def __init__(self, config: JudgeConfig) -> None:
        self.config = config

    def quick(self, checkpoint: Path, minutes: float) -> dict[str, float]:
        """See :class:`pace.rl.judge.Judge`."""
        if not self.config.serves or minutes < self.config.after:
            return {}
        row = self._play(checkpoint, self.config.serves, self.config.worlds)
        return {} if row is None else {"eval_hit": row.summary["hit"], "eval_success": row.summary["success"]}

    def last(self, run: Path, minutes: float) -> None:
        """See :class:`pace.rl.judge.Judge`. Ctrl-C leaves it out."""
        config = self.config
        if not config.last_serves or minutes < config.after:
            return
        tell(f"judging {config.last_serves} {config.serve} serves without exploration (Ctrl-C leaves it out)")
        row = self._play(run, config.last_serves, config.last_worlds)
        if row is not None:
            self._report(run, row)

    def _play(self, run: Path, serves: int, worlds: int) -> Row | None:
        """A row of the table; None, with a warning, if its serves cannot be played."""
        config = self.config
        with torch.random.fork_rng(devices=[]):  # making networks and worlds takes random numbers
            policy = policy_on("table", load_policy(run))
            try:
                return evaluate_row(
                    policy,
                    config.serve,
                    serves,
                    min(worlds, serves),
                    DEVICE,
                    SEED,
                    self._overrides,
                    config.warmup_serves,
                )
            except EvaluationError as error:
                say(f"warning: {run} cannot be judged: {error}")
                return None

    @property
    def _overrides(self) -> list[str]:
        return [f"engine.physics_dt={self.config.physics_dt}"]

    def _report(self, run: Path, row: Row) -> None:
        """Print the row beside the paper's, and write files and figures."""
        saved = load_policy(run)
        policy = policy_on("table", saved)
        given = [f"run='{run}'", f"rows=[{self.config.serve}]", f"serves={self.config.last_serves}", f"seed={SEED}"]
        given += [f"num_worlds={self.config.last_worlds}", f"device={DEVICE}", "first_ball=[]"]
        options = parse(compose("evaluate", given), EvaluateConfig)
        tell(task_line("table", saved.config, policy.config))
        tell(closing_table(row.summary, options.paper))
        try:
            folder = make_out(str(run / EVALUATION), "evaluation", [*REPORT, *FIGURES])
        except ConfigError as error:  # the run is complete, whatever is in the way there
            say(f"warning: {error}")
            return
        files = write_report(folder, [row], options.paper, circumstances(options, policy, self._overrides))
        target = (saved.config.landing_target[0], saved.config.landing_target[1])
        files += write_figures(folder, [row], saved.config.ball.table, target, self.config.warmup_serves)
        tell(f"wrote {folder}: {', '.join(file.name for file in files)}")


def closing_table(row: Mapping[str, Any], paper: Mapping[str, PaperRow]) -> str:
    """A row of an evaluation, with intervals, above the paper's."""
    header = (f"{row['serves']:,} {row['serve']} serves", "hit %", "95 %", "success %", "95 %", "falls/1,000")
    shares = (number(row["hit"], 100), interval(row, "hit"), number(row["success"], 100), interval(row, "success"))
    body = [("this run", *shares, number(row["falls_per_1000"]))]
    published = paper.get(row["serve"])
    if published:
        body.append(("the paper", number(published.hit, 100), "", number(published.success, 100), "", ""))
    return text_table(header, body)
