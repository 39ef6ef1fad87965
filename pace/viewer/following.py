"""The page of ``pace watch``: that of ``pace play`` on the newest checkpoint of a run that trains."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from omegaconf import DictConfig

from pace.config.base import parse
from pace.config.page import WatchConfig
from pace.evaluation.sweep import ball_presets
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.checkpoint_folders import CheckpointError, list_checkpoints
from pace.runs.metrics import last_row
from pace.runs.run_folder import METRICS, is_run
from pace.viewer.playback import Show, Snapshot
from pace.viewer.server import require_port, require_viewer
from pace.viewer.web import Page

BARS_EVERY = 0.2  # s between two pictures of the bars
LOOK_EVERY = 1.0  # s between two looks for the first checkpoint
SHOWN = {"hit_rate": "hits", "success_rate": "returns"}


class FollowingPage(Page):
    """:class:`pace.viewer.web.Page` of a run: takes a newer checkpoint when it is written, and shows the reward.

    Args: run: folder of the run; rewards: whether to compute and show the reward terms; others as those of the page.
    """

    def __init__(
        self,
        run: Path,
        policy: TaskPolicy,
        overrides: Sequence[str],
        balls: Sequence[str],
        rewards: bool,
        **where: object,
    ) -> None:
        self._run, self._rewards = run, rewards
        self._next_bars = 0.0
        super().__init__(policy, overrides, balls, **where)  # type: ignore[arg-type]

    def _make_show(self, policy: TaskPolicy, overrides: Sequence[str]) -> Show:
        return Show(policy, overrides, self._seed, rewards=self._rewards)

    def _build_controls(self, balls: Sequence[str], speed: float) -> None:
        super()._build_controls(balls, speed)
        gui = self.server.gui
        self._progress = gui.add_markdown(progress(self._run))
        self._newest = gui.add_checkbox("Follow the newest checkpoint", initial_value=True)
        if self.show.bars is not None:
            with gui.add_folder("Reward per second"):
                self._bars = gui.add_html(self.show.bars.html())

    def _look_for_checkpoints(self) -> None:
        due = time.monotonic() >= self._next_look
        super()._look_for_checkpoints()
        if not due:
            return
        self._progress.content = progress(self._run)
        names = self._names()
        if self._newest.value is True and names and names[0] != Path(self._policy.source).name:
            self._change_checkpoint(names[0])
            if Path(self._policy.source).name == names[0]:  # it was loaded
                self._checkpoint.value = names[0]

    def draw(self, snapshot: Snapshot) -> None:
        """Send all changes to the browsers."""
        super().draw(snapshot)
        if self.show.bars is not None and time.monotonic() >= self._next_bars:
            self._next_bars = time.monotonic() + BARS_EVERY
            self._bars.content = self.show.bars.html()


def progress(run: Path) -> str:
    """How far the training is, in one line, from its last row of metrics."""
    row = last_row(run / METRICS)
    if not row:
        return "no update yet"
    rates = [f"{label} {100 * row[name]:.1f} %" for name, label in SHOWN.items() if row.get(name) == row.get(name, 0.0)]
    said = [f"training: update {int(row['update'])}", f"{row['samples'] / 1e6:.2f} M samples", *rates]
    return ", ".join(said) + (" while exploring" if rates else "")


def wait_for_checkpoint(run: Path, say: Callable[[str], None], pause: float = LOOK_EVERY) -> None:
    """Return when ``run`` has a checkpoint; says once that it waits.

    Errors: :class:`CheckpointError` for a folder that is no run.
    """
    if not is_run(run):
        raise CheckpointError(f"{run} is no run folder: give the folder of a run that trains")
    if not list_checkpoints(run):
        say(f"{run} has no checkpoint yet (checkpoint_minutes= of the training says how often): waiting for it")
    while not list_checkpoints(run):
        time.sleep(pause)


def watch_from_config(composed: DictConfig) -> None:
    """Show the page of a run that trains until Ctrl-C, and print its address."""
    config = parse(composed, WatchConfig)
    assert config.run is not None  # guaranteed by WatchConfig
    require_viewer()
    require_port(config.host, config.port)
    run = Path(config.run)
    try:
        wait_for_checkpoint(run, lambda text: print(text, flush=True))
        policy = load_policy(run)
        overrides = [f"engine.physics_dt={config.physics_dt}", *config.overrides]
        where = {"host": config.host, "port": config.port, "speed": config.speed, "seed": config.seed}
        shown = FollowingPage(run, policy, overrides, ball_presets(), config.rewards, **where)
        print(f"run {run}, {Path(policy.source).name}\nopen {shown.url} in a browser; Ctrl-C ends it", flush=True)
        shown.run()
    except KeyboardInterrupt:
        print("\nended")
