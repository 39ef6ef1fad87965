"""Images of the scene without a window, with marks and lines drawn into it. Needs OpenGL (EGL on a headless machine).

Colours are r, g, b, a in 0 to 1; pictures are uint8 (height, width, 3).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float, float]
Picture = NDArray[np.uint8]

NO_GL = (
    "there is no OpenGL to draw with. Debian, Ubuntu: apt install libegl1 libgles2 libgl1-mesa-dri "
    "(an NVIDIA driver brings its EGL). MUJOCO_GL=egl|glfw|osmesa chooses another backend"
)
SHADOW_SIZE = 1024  # pixels; software rendering spends most of its time on shadows


class RenderError(RuntimeError):
    """OpenGL is missing; the message says what to install."""


@dataclass(frozen=True)
class Ball:
    """A sphere to draw: centre (3,) m, radius m."""

    centre: NDArray[np.floating]
    radius: float
    colour: Colour


@dataclass(frozen=True)
class Line:
    """A polyline to draw: points (M, 3) m, width in pixels."""

    points: NDArray[np.floating]
    width: float
    colour: Colour


Mark = Ball | Line


def top_camera(x: float, y: float, height: float) -> mujoco.MjvCamera:
    """Looks straight down on (x, y) m from ``height`` m; x to the right, y up."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (x, y, 0.0)
    camera.distance, camera.azimuth, camera.elevation = height, 90.0, -90.0
    return camera


def _gl_context() -> Any:
    """MuJoCo's class of OpenGL contexts; EGL if there is no screen and MUJOCO_GL is not set."""
    headless = sys.platform == "linux" and not os.environ.get("DISPLAY") and not os.environ.get("WAYLAND_DISPLAY")
    if headless and not os.environ.get("MUJOCO_GL"):
        from mujoco.egl import GLContext

        return GLContext
    from mujoco.gl_context import GLContext

    return GLContext


class SceneRenderer:
    """Draws states of one model. Close it after use, or use it as a context manager.

    Args: model: with its visual geoms; width, height: pixels.
    Errors: :class:`RenderError` without OpenGL.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        model.vis.quality.shadowsize = SHADOW_SIZE
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self.model, self.data = model, mujoco.MjData(model)
        self._scene = mujoco.MjvScene(model, maxgeom=4000)
        self._option = mujoco.MjvOption()
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._picture = np.zeros((height, width, 3), dtype=np.uint8)
        try:
            self._gl = _gl_context()(width, height)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except (ImportError, AttributeError, RuntimeError, mujoco.FatalError) as error:
            if "framebuffer is not complete" in str(error):
                raise RenderError(f"OpenGL draws no picture of {width} x {height} pixels: give less") from error
            raise RenderError(f"{NO_GL} ({str(error).splitlines()[0]})") from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def __enter__(self) -> SceneRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the memory on the graphics device."""
        self._context.free()
        self._gl.free()

    def set_state(self, qpos: NDArray[np.floating], ball: NDArray[np.floating]) -> None:
        """Set robot qpos (7 + J,) and ball position (3,) m of the next pictures."""
        self.data.qpos[:] = qpos
        self.data.mocap_pos[0] = ball
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def draw(self, camera: str | mujoco.MjvCamera, marks: Sequence[Mark] = ()) -> Picture:
        """A new picture from a camera of the model, or a free one, with ``marks`` in it."""
        view = camera if isinstance(camera, mujoco.MjvCamera) else self._fixed(camera)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateCamera(self.model, self.data, view, self._scene)  # first: the headlight uses its last position
        mujoco.mjv_updateScene(self.model, self.data, self._option, None, view, everything, self._scene)
        for mark in marks:
            self._add(mark)
        mujoco.mjr_render(self._rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(self._picture, None, self._rectangle, self._context)
        return np.flipud(self._picture).copy()

    def _fixed(self, name: str) -> mujoco.MjvCamera:
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        camera.fixedcamid = self.model.camera(name).id
        return camera

    def _add(self, mark: Mark) -> None:
        if isinstance(mark, Ball):
            size = np.full(3, mark.radius)
            self._geom(mujoco.mjtGeom.mjGEOM_SPHERE, size, mark.centre, mark.colour)
            return
        for start, end in zip(mark.points[:-1], mark.points[1:], strict=True):
            geom = self._geom(mujoco.mjtGeom.mjGEOM_LINE, np.ones(3), np.zeros(3), mark.colour)
            ends = start.astype(np.float64), end.astype(np.float64)
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_LINE, mark.width, *ends)

    def _geom(self, kind: int, size: NDArray, centre: NDArray, colour: Colour) -> Any:
        """The next free geom of the scene."""
        geom = self._scene.geoms[self._scene.ngeom]
        place = np.asarray(centre, dtype=np.float64)
        mujoco.mjv_initGeom(geom, kind, size, place, np.eye(3).flatten(), np.array(colour, dtype=np.float32))
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR
        geom.emission = 0.5
        self._scene.ngeom += 1
        return geom


def caption(picture: Picture, text: str) -> Picture:
    """A copy of ``picture`` with ``text`` in its upper left corner."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    for offset, colour in (((9, 7), (0, 0, 0)), ((8, 6), (255, 255, 255))):  # white with a shadow
        draw.multiline_text(offset, text, fill=colour, font_size=15, spacing=3)
    return np.asarray(image)
