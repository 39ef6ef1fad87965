"""The video of :mod:`pace.viewer`: the scene from the side and from the top, with the same marks as the page."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np
from PIL import Image

from pace.config.extras import cure
from pace.config.sim import SimConfig
from pace.sim.render import Picture, RenderError, SceneRenderer, caption, top_camera
from pace.sim.robot import build_model
from pace.viewer.playback import Snapshot

TOP = (-0.75, 0.0, 4.2)  # m: x, y and height of the camera
BLOCK = 2  # pixels: the codec halves the colours' resolution
QUALITY = 60  # of a WebP, of 100


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


def strike_camera() -> mujoco.MjvCamera:
    """From behind the robot's right shoulder, near enough to see paddle and ball meet."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (-1.1, -0.1, 0.86)
    camera.distance, camera.azimuth, camera.elevation = 2.25, 60.0, -13.0
    return camera


def cameras(view: str) -> list[mujoco.MjvCamera]:
    """Cameras of a view of ``play.view``, whose pictures stand one above the other."""
    return [strike_camera()] if view == "strike" else [side_camera(), top_camera(*TOP)]


def pictures(
    show: Shown, seconds: float, fps: int, speed: float, width: int, height: int, view: str = "both"
) -> Iterator[Picture]:
    """``seconds`` of play at ``fps`` frames a second of video, time slowed by ``speed``: uint8 (H, width, 3).

    H is ``height`` for each camera of the view.

    Errors: :class:`pace.sim.render.RenderError` without OpenGL.
    """
    config = show.config
    model = build_model(config.robot, config.engine, config.ball.table, visual=True)
    with SceneRenderer(model, width, height) as renderer:
        for _ in range(max(1, round(seconds * fps / speed))):
            snapshot = show.advance(speed / fps)
            renderer.set_state(snapshot.qpos, snapshot.ball)
            views = [renderer.draw(camera, snapshot.marks()) for camera in cameras(view)]
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
    view: str = "both",
) -> None:
    """Write a video as H.264, or by its suffix as WebP or GIF; what was there is replaced when it is complete.

    Errors: :class:`pace.sim.render.RenderError` if OpenGL or a package is missing, or the file cannot be written.
    """
    encode = encoder_of(file)
    film = pictures(show, seconds, fps, speed, width, height, view)
    first = next(film)  # fails without OpenGL, before the file is made
    part = file.with_name(f".{file.stem}.{os.getpid()}.tmp{file.suffix}")  # the encoder goes by the suffix
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        part.touch()  # the encoder would only report a broken pipe
        encode(part, _told(chain([first], film), on_picture), fps)
        part.replace(file)
    except OSError as error:
        raise RenderError(f"{file} cannot be written: {str(error).strip().splitlines()[0]}") from error
    finally:
        part.unlink(missing_ok=True)


def encoder_of(file: Path) -> Callable[[Path, Iterator[Picture], int], None]:
    """What writes a file of that suffix. Errors: :class:`pace.sim.render.RenderError` if a package is missing."""
    if file.suffix != ".mp4":
        return write_animation
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise RenderError(f"{error}: {cure('viewer')}") from error
    return write_h264


def _told(film: Iterator[Picture], on_picture: Callable[[], None]) -> Iterator[Picture]:
    for picture in film:
        yield picture
        on_picture()


def write_h264(file: Path, film: Iterator[Picture], fps: int) -> None:
    """Write pictures as H.264. Errors: ``OSError``, also for an end that was not written."""
    import imageio_ffmpeg

    first = next(film)
    size = (first.shape[1], first.shape[0])
    writer = imageio_ffmpeg.write_frames(str(file), size, fps=fps, codec="libx264", quality=7, macro_block_size=BLOCK)
    writer.send(None)
    for picture in chain([first], film):
        writer.send(np.ascontiguousarray(picture))
    writer.close()  # which does not tell whether the encoder could write the end
    written = imageio_ffmpeg.read_frames(str(file))
    next(written)
    written.close()


def write_animation(file: Path, film: Iterator[Picture], fps: int) -> None:
    """Write pictures as an endless WebP or GIF, which a page shows like a picture. Errors: ``OSError``."""
    frames = [Image.fromarray(picture) for picture in film]
    frames[0].save(
        file, save_all=True, append_images=frames[1:], duration=round(1000 / fps), loop=0, quality=QUALITY, method=6
    )
