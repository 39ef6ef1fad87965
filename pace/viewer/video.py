"""The video of :mod:`pace.viewer`: the scene from the side and from the top, with the same marks as the page."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np

from pace.config.extras import cure
from pace.config.sim import SimConfig
from pace.sim.render import Picture, RenderError, SceneRenderer, caption, top_camera
from pace.sim.robot import build_model
from pace.viewer.playback import Snapshot

TOP = (-0.75, 0.0, 4.2)  # m: x, y and height of the camera
BLOCK = 2  # pixels: the codec halves the colours' resolution


class Shown(Protocol):
    """What a video shows: a :class:`pace.viewer.playback.Show`, or a replay."""

    @property
    def config(self) -> SimConfig:
        """Robot and table."""
        ...

    def advance(self, seconds: float) -> Snapshot:
        """The state after ``seconds`` more."""
        ...

    def text(self) -> str:
        """What is written into the pictures, in parts that " | " separates."""
        ...


def side_camera() -> mujoco.MjvCamera:
    """From the robot's right, robot and table in view."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (-0.7, 0.0, 0.75)
    camera.distance, camera.azimuth, camera.elevation = 4.2, 90.0, -10.0
    return camera


def pictures(show: Shown, seconds: float, fps: int, speed: float, width: int, height: int) -> Iterator[Picture]:
    """``seconds`` of play at ``fps`` frames a second of video, time slowed by ``speed``: uint8 (2 height, width, 3).

    Errors: :class:`pace.sim.render.RenderError` without OpenGL.
    """
    config = show.config
    model = build_model(config.robot, config.engine, config.ball.table, visual=True)
    with SceneRenderer(model, width, height) as renderer:
        for _ in range(max(1, round(seconds * fps / speed))):
            snapshot = show.advance(speed / fps)
            renderer.set_state(snapshot.qpos, snapshot.ball)
            views = [renderer.draw(camera, snapshot.marks()) for camera in (side_camera(), top_camera(*TOP))]
            yield caption(np.concatenate(views), show.text().replace(" | ", "\n"))


def write_video(
    file: Path,
    show: Shown,
    seconds: float,
    fps: int,
    speed: float,
    width: int,
    height: int,
    on_picture: Callable[[], None] = lambda: None,
) -> None:
    """Write a video as H.264; what was there is replaced when it is complete.

    Errors: :class:`pace.sim.render.RenderError` if OpenGL or a package is missing, or the file cannot be written.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise RenderError(f"{error}: {cure('viewer')}") from error
    film = pictures(show, seconds, fps, speed, width, height)
    first = next(film)  # fails without OpenGL, before the file is made
    part = file.with_name(f".{file.stem}.{os.getpid()}.tmp{file.suffix}")  # the encoder goes by the suffix
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        part.touch()  # the encoder would only report a broken pipe
        writer = imageio_ffmpeg.write_frames(
            str(part), (width, 2 * height), fps=fps, codec="libx264", quality=7, macro_block_size=BLOCK
        )
        writer.send(None)
        for picture in chain([first], film):
            writer.send(np.ascontiguousarray(picture))
            on_picture()
        writer.close()  # which does not tell whether the encoder could write the end
        written = imageio_ffmpeg.read_frames(str(part))
        next(written)
        written.close()
        part.replace(file)
    except OSError as error:
        raise RenderError(f"{file} cannot be written: {str(error).strip().splitlines()[0]}") from error
    finally:
        part.unlink(missing_ok=True)
