"""Pictures of the scene: what is drawn where, and what is said where nothing can be drawn."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from pace.config.training import load_train_config
from pace.sim import render
from pace.sim.render import Ball, Line, RenderError, SceneRenderer, caption, top_camera
from pace.sim.robot import NOMINAL_KEY, build_model

WIDTH, HEIGHT = 160, 96
GREEN = (0.0, 1.0, 0.0, 1.0)


def make_model() -> mujoco.MjModel:
    config = load_train_config()
    return build_model(config.robot, config.engine, config.ball.table, visual=True)


@pytest.fixture(scope="module")
def renderer() -> Iterator[SceneRenderer]:
    try:
        made = SceneRenderer(make_model(), WIDTH, HEIGHT)
    except RenderError as error:
        pytest.skip(str(error))
    made.set_state(made.model.key(NOMINAL_KEY).qpos, np.array([0.5, 0.3, 1.0]))
    yield made
    made.close()


def green(picture: render.Picture) -> np.ndarray:
    """Rows and columns of green pixels (K, 2)."""
    red, strong, blue = (picture[..., i].astype(int) for i in range(3))
    return np.argwhere((strong > 120) & (red < strong - 60) & (blue < strong - 60))


def test_marks_are_where_they_belong(renderer: SceneRenderer) -> None:
    top = top_camera(0.0, 0.0, 4.0)
    assert len(green(renderer.draw(top))) == 0
    for x, y in ((1.0, 0.5), (-1.0, -0.5)):
        pixels = green(renderer.draw(top, [Ball(np.array([x, y, 1.2]), 0.1, GREEN)]))
        assert len(pixels) > 10
        row, column = pixels.mean(axis=0)
        assert (column > WIDTH / 2) == (x > 0)  # x to the right
        assert (row < HEIGHT / 2) == (y > 0)  # y up
    line = Line(np.array([[-1.0, 0.0, 1.2], [0.0, 0.2, 1.2], [1.0, 0.0, 1.2]]), 2.0, GREEN)
    columns = green(renderer.draw(top, [line]))[:, 1]
    assert columns.max() - columns.min() > 0.3 * WIDTH


def test_the_state_is_drawn(renderer: SceneRenderer) -> None:
    first = renderer.draw("side")
    assert first.shape == (HEIGHT, WIDTH, 3)
    assert np.array_equal(renderer.draw("side"), first)
    qpos = renderer.model.key(NOMINAL_KEY).qpos.copy()
    qpos[0] -= 0.5
    renderer.set_state(qpos, np.array([0.5, 0.3, 1.0]))
    assert np.abs(renderer.draw("side").astype(int) - first).max() > 50


def test_a_caption_leaves_the_picture_alone() -> None:
    picture = np.zeros((60, 200, 3), dtype=np.uint8)
    written = caption(picture, "serves 3\nhits 2")
    assert written.shape == picture.shape
    assert written[:20].max() == written[20:45].max() == 255
    assert picture.max() == 0


def test_without_opengl_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    class NoContext:
        def __init__(self, width: int, height: int) -> None:
            raise AttributeError("'NoneType' object has no attribute 'eglQueryString'\nand so on")

    monkeypatch.setattr(render, "_gl_context", lambda: NoContext)
    with pytest.raises(RenderError, match=r"apt install libegl1 libgles2.*eglQueryString'\)$"):
        SceneRenderer(make_model(), WIDTH, HEIGHT)
