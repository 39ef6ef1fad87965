"""The command ``pace play``: a live page or a video of a policy."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from pathlib import Path

from omegaconf import DictConfig
from tqdm import tqdm

from pace.config.base import ConfigError, compose, parse
from pace.config.page import PlayConfig
from pace.evaluation.sweep import ball_presets
from pace.rl.policies import TaskPolicy, built_in_policy, load_policy
from pace.runs.own_files import started_out
from pace.runs.progress import SECONDS_PER_LINE
from pace.runs.run_folder import REPLAY_SUFFIX
from pace.viewer.playback import Show
from pace.viewer.replay import ReplayPage, load_show
from pace.viewer.server import require_viewer
from pace.viewer.video import Shown, write_video
from pace.viewer.web import Page


def play_from_config(composed: DictConfig) -> None:
    """Play as configured, and print the address or the file."""
    config = parse(composed, PlayConfig)
    assert config.run is not None  # guaranteed by PlayConfig
    if config.run.endswith(REPLAY_SUFFIX):
        replay(config)
        return
    policy = load_policy(config.run)
    if config.policy != "run":
        policy = built_in_policy(config.policy, config.seed, like=policy)
    overrides = [f"engine.physics_dt={config.physics_dt}", *config.overrides]
    if config.video:
        with place_of(config.video):  # before the worlds are made, which may compile
            film(config, Show(policy, overrides, config.seed), f"policy {policy.source}")
    else:
        page(config, policy, overrides)


def place_of(video: str) -> AbstractContextManager[Path]:
    """The folder of a video, claimed for it; one that is made and not used is removed."""
    file = Path(video)
    return started_out(str(file.parent), "video", [file.name])


def page(config: PlayConfig, policy: TaskPolicy, overrides: list[str]) -> None:
    """Show the page until Ctrl-C."""
    shown = Page(policy, overrides, ball_presets(), config.host, config.port, config.speed, config.seed)
    print(f"policy {policy.source}\nopen {shown.url} in a browser; Ctrl-C ends it", flush=True)
    try:
        shown.run()
    except KeyboardInterrupt:
        print("\nended")


def replay(config: PlayConfig) -> None:
    """Show what went wrong in a training run, on the page or in a video of ``seconds``."""
    assert config.run is not None
    if config.overrides:
        raise ConfigError("a replay shows what was: it takes no changes of the task")
    show = load_show(Path(config.run))
    if config.video:
        with place_of(config.video):
            film(config, show, f"replay {config.run}")
        return
    require_viewer()
    shown = ReplayPage(show, config.host, config.port)
    print(f"replay {config.run}\nopen {shown.url} in a browser; Ctrl-C ends it", flush=True)
    try:
        shown.run()
    except KeyboardInterrupt:
        print("\nended")


def film(config: PlayConfig, show: Shown, about: str) -> None:
    """Write the video."""
    assert config.video
    file = Path(config.video)
    total = round(config.seconds * config.fps / config.speed)
    size = (config.width, config.height)
    interval = 0.2 if sys.stderr.isatty() else SECONDS_PER_LINE
    with tqdm(total=total, desc=file.name, unit="picture", mininterval=interval) as bar:
        write_video(
            file, show, config.seconds, config.fps, config.speed, *size, on_picture=lambda: _tick(bar), view=config.view
        )
    print(f"{about}\n{show.text()}\nwrote {file}")


def film_run(run: Path, file: Path, seconds: float) -> None:
    """Write a video of a run's newest policy, as ``pace play`` does if nothing else is asked.

    Errors: :class:`pace.sim.render.RenderError` if OpenGL or a package is missing, or the file cannot be written.
    """
    usual = parse(compose("play", [f"run='{run}'", f"video='{file}'", f"seconds={seconds}"]), PlayConfig)
    show = Show(load_policy(run), [f"engine.physics_dt={usual.physics_dt}"], usual.seed)
    write_video(file, show, seconds, usual.fps, usual.speed, usual.width, usual.height)


def _tick(bar: tqdm) -> None:
    bar.update()
