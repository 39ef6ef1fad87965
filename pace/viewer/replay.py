"""A replay: the last control steps of worlds whose numbers went wrong, on a page or in a video."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pace.config.base import ConfigError, parse
from pace.config.training import TrainConfig
from pace.sim.replay import Replay, ReplayError, WorldReplay, load_replay
from pace.sim.robot_spec import RobotSpec
from pace.viewer.playback import Snapshot
from pace.viewer.scene import BrowserScene
from pace.viewer.server import number, open_server, stop

FRAME = 1.0 / 30.0  # s between pictures
PAUSE = 0.5  # s on the last state, before the next world
SPEED = 0.25  # of time, at first


class ReplayShow:
    """The worlds of a replay, one after another, again and again; between control steps it is interpolated.

    Attributes: ``config`` of the task.

    Errors: :class:`ReplayError` for a configuration of another version, or states of another robot.
    """

    def __init__(self, replay: Replay, file: Path) -> None:
        try:
            self.config = parse(replay.config, TrainConfig)
        except ConfigError as error:
            raise ReplayError(f"{file} is of another version of pace: {error}") from error
        joints = len(RobotSpec.of(self.config.robot).joints)
        if any(world.qpos.shape[1] != 7 + joints for world in replay.worlds) or not replay.worlds:
            raise ReplayError(f"{file} holds no states of the robot {self.config.robot.name}")
        self._worlds, self._reason = replay.worlds, replay.reason
        self._index, self._seconds, self._shown = 0, 0.0, 1

    @property
    def names(self) -> tuple[str, ...]:
        """Of the worlds, in the order of the show."""
        return tuple(f"world {world.world}" for world in self._worlds)

    def choose(self, name: str) -> None:
        """Begin again with the world of that name."""
        self._begin(self.names.index(name))

    def _begin(self, index: int) -> None:
        self._index, self._seconds, self._shown = index, 0.0, self._shown + 1

    def advance(self, seconds: float) -> Snapshot:
        """The snapshot after ``seconds`` more."""
        self._seconds += seconds
        if self._step > len(self._world.qpos) - 1 + PAUSE / self.config.robot.control_dt:
            self._begin((self._index + 1) % len(self._worlds))
        world, step = self._world, min(self._step, len(self._world.qpos) - 1.0)
        qpos, ball = _between(world.qpos.double().numpy(), step), _between(world.ball.double().numpy(), step)
        stand = np.array([qpos[0], qpos[1], 0.0])
        trail = world.ball[:, :3].double().numpy()
        trail = np.concatenate([trail, trail[-1:]])  # a line has at least two points
        return Snapshot(qpos, ball[:3], trail, self._shown, None, None, stand)

    @property
    def _world(self) -> WorldReplay:
        return self._worlds[self._index]

    @property
    def _step(self) -> float:
        return self._seconds / self.config.robot.control_dt

    def text(self) -> str:
        """World, time to the event, and the event."""
        left = max(0.0, len(self._world.qpos) - 1 - self._step) * self.config.robot.control_dt
        when = f"{left:.2f} s before it" if left else "in the next step"
        return f"{self.names[self._index]} ({self._index + 1} of {len(self._worlds)}) | {when} | {self._reason}"


def _between(states: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    low = int(step)
    high = min(low + 1, len(states) - 1)
    return states[low] + (step - low) * (states[high] - states[low])


def load_show(file: Path) -> ReplayShow:
    """The show of a replay file. Errors: :class:`ReplayError`."""
    return ReplayShow(load_replay(file), file)


class ReplayPage:
    """A replay in all connected browsers.

    Attributes: ``url``. Errors: :class:`pace.viewer.server.PageError` for a port that cannot be opened.
    """

    def __init__(self, show: ReplayShow, host: str, port: int) -> None:
        self.show = show
        self.server, self.url = open_server(host, port)
        self._scene = BrowserScene(self.server, show.config)
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        self._text = gui.add_markdown(show.text())
        self._speed = gui.add_slider("Speed of time", min=0.01, max=1.0, step=0.01, initial_value=SPEED)
        self._choice = gui.add_dropdown("World", show.names)
        self._asked: str | None = None
        self._choice.on_update(self._ask)

    def _ask(self, _: object) -> None:
        self._asked = self._choice.value  # taken by the loop

    def run(self, ended: Callable[[], bool] = lambda: False) -> None:
        """Play until ``ended`` or Ctrl-C; then close the server."""
        try:
            while not ended():
                asked, self._asked = self._asked, None
                if asked in self.show.names:  # a browser may send anything
                    self.show.choose(asked)
                self._scene.draw(self.show.advance(FRAME * number(self._speed, SPEED)))
                if self._text.content != self.show.text():
                    self._text.content = self.show.text()
                time.sleep(FRAME)
        finally:
            stop(self.server)
