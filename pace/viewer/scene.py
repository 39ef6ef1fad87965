"""The scene in the browsers: robot, ball, table, marks and flight line. Needs the extra ``viewer``."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from pace.config.sim import SimConfig
from pace.sim.render import Colour
from pace.sim.robot import build_model
from pace.viewer.playback import (
    APEX_COLOUR,
    APEX_RADIUS,
    BASE_COLOUR,
    BASE_RADIUS,
    FLIGHT_COLOUR,
    FLIGHT_WIDTH,
    PREDICTION_COLOUR,
    PREDICTION_RADIUS,
    Snapshot,
)

CAMERA, LOOK_AT = (-2.9, -2.6, 1.7), (-0.7, 0.0, 0.8)  # m, the first view


class BrowserScene:
    """Robot, ball and table of ``config`` in all browsers of a viser ``server``."""

    def __init__(self, server: Any, config: SimConfig) -> None:
        from mjviser import ViserMujocoScene

        self._server = server
        model = build_model(config.robot, config.engine, config.ball.table, visual=True)
        self._data = mujoco.MjData(model)
        self._scene = ViserMujocoScene(server, model, num_envs=1)
        self._scene.camera_tracking_enabled = False  # the marks are in the world's frame
        server.initial_camera.position, server.initial_camera.look_at = CAMERA, LOOK_AT
        self._marks = {
            "apex": self._mark("apex", APEX_RADIUS, APEX_COLOUR),
            "prediction": self._mark("prediction", PREDICTION_RADIUS, PREDICTION_COLOUR),
            "base_target": self._mark("base_target", BASE_RADIUS, BASE_COLOUR),
        }
        self._drawn_flight = 0

    def _mark(self, name: str, radius: float, colour: Colour) -> Any:
        return self._server.scene.add_icosphere(f"/marks/{name}", radius, _rgb(colour), cast_shadow=False)

    def forget_flight(self) -> None:
        """The numbers of flight lines begin again."""
        self._drawn_flight = 0

    def draw(self, snapshot: Snapshot) -> None:
        """Send all changes to the browsers."""
        self._data.qpos[:] = snapshot.qpos
        self._data.mocap_pos[0] = snapshot.ball
        mujoco.mj_kinematics(self._scene.mj_model, self._data)
        with self._server.atomic():
            for name, handle in self._marks.items():
                place = getattr(snapshot, name)
                handle.visible = place is not None
                if place is not None:
                    handle.position = place
            if snapshot.flight_number != self._drawn_flight:
                self._drawn_flight = snapshot.flight_number
                self._draw_flight(snapshot)
            self._scene.update_from_mjdata(self._data)

    def _draw_flight(self, snapshot: Snapshot) -> None:
        pieces = np.stack((snapshot.flight[:-1], snapshot.flight[1:]), axis=1)
        look = {"thickness": FLIGHT_WIDTH, "thickness_units": "screen"}
        self._server.scene.add_line_segments("/marks/flight", pieces, _rgb(FLIGHT_COLOUR), **look)


def _rgb(colour: Colour) -> tuple[int, int, int]:
    red, green, blue, _ = (round(255 * part) for part in colour)
    return red, green, blue
