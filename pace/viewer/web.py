"""The live page of :mod:`pace.viewer`: the scene in a browser, with controls. Needs the extra ``viewer``.

The browser's events arrive on threads of the server. They only put requests into a queue; one loop handles them, rolls
out and draws.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue

from pace.config.base import ConfigError, printable
from pace.rl.policies import TaskPolicy, load_policy
from pace.runs.checkpoint import CheckpointError
from pace.runs.checkpoint_folders import FOLDER, list_checkpoints
from pace.viewer.playback import Serve, Show, Snapshot
from pace.viewer.scene import BrowserScene
from pace.viewer.server import number, open_server, require_port, require_viewer, stop

FRAME = 1.0 / 30.0  # s between pictures
LONGEST_FRAME = 0.1  # s: a page does not catch up after a longer delay
SLOWEST = 0.05  # speed of time, unless the user asks for less
IDLE = 0.1  # s between checks for a connected browser
LOOK_FOR_CHECKPOINTS = 5.0  # s: a training run may write new ones
#: Sliders of a serve: label, least, largest, step, start, hint. In the order of :class:`Serve`.
SERVE_SLIDERS = (
    ("Speed (m/s)", 4.5, 7.5, 0.05, 5.8, "over the ground"),
    ("Direction (°)", -10.0, 10.0, 0.1, -1.0, "to the robot's left"),
    ("Upward (m/s)", 1.0, 3.0, 0.05, 1.75, "at the start"),
    ("Topspin (rad/s)", -150.0, 150.0, 5.0, 0.0, "acts at every bounce, and in the air with the ball venue"),
    ("Sidespin (rad/s)", -150.0, 150.0, 5.0, 0.0, "to the robot's left when positive"),
)
LEGEND = (
    "Green: apex of the flight. Yellow: the predictor's. Blue: where the base should stand. Line: the flight ahead."
)


def checkpoints_of(policy: TaskPolicy) -> list[Path]:
    """All checkpoints of the run that ``policy`` comes from, newest last; at least its own."""
    own = Path(policy.source)
    return list_checkpoints(own.parent.parent) if own.parent.name == FOLDER else [own]


class Page:
    """Shows a policy in all connected browsers, in real time or slower.

    Attributes: ``show``, ``server`` (viser), ``url``.

    Args:
        policy: as :func:`pace.rl.load_policy` gives it.
        overrides: of the saved task.
        balls: names of ball presets to choose from.
        host, port: to listen on. With another host than the local one, who has the token in ``url`` has the controls.
        speed: of time, 1 for real time.
        seed: of all random numbers.

    Errors: :class:`pace.viewer.server.PageError`; :class:`pace.config.ConfigError` for wrong overrides.
    """

    def __init__(
        self,
        policy: TaskPolicy,
        overrides: Sequence[str],
        balls: Sequence[str],
        host: str = "127.0.0.1",
        port: int = 8080,
        speed: float = 1.0,
        seed: int = 1,
    ) -> None:
        require_viewer()
        require_port(host, port)
        self._overrides, self._seed = list(overrides), seed
        self._balls = tuple(balls)
        self._ball: str | None = None  # that of the overrides, or of the saved task
        self._policy = policy
        self._requests: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self.show = self._make_show(policy, overrides)
        self.server, self.url = open_server(host, port)
        self._scene = BrowserScene(self.server, self.show.config)
        self._build_controls(balls, speed)
        self._next_look = 0.0

    def _make_show(self, policy: TaskPolicy, overrides: Sequence[str]) -> Show:
        return Show(policy, overrides, self._seed)

    def draw(self, snapshot: Snapshot) -> None:
        """Send all changes to the browsers."""
        self._scene.draw(snapshot)
        self._say(self.show.text())

    def _say(self, text: str) -> None:
        if self._score.content != text:
            self._score.content = text

    # --- controls -----------------------------------------------------------------------------------------------------

    def _build_controls(self, balls: Sequence[str], speed: float) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        gui.main_panel.dock_right()
        self._score = gui.add_markdown(self.show.text())
        next_serve = gui.add_button("Next serve")
        next_serve.on_click(lambda _: self._ask(lambda: self.show.next_serve(self.serve)))
        ball = gui.add_button_group("Ball", tuple(balls))
        ball.on_click(lambda _: self._ask(lambda: self._change_ball(ball.value)))
        least = min(SLOWEST, speed)
        self._time = gui.add_slider("Speed of time", min=least, max=1.0, step=least, initial_value=speed)
        self._build_serve()
        self._checkpoint = gui.add_dropdown("Checkpoint", self._names(), initial_value=Path(self._policy.source).name)
        self._checkpoint.on_update(lambda _: self._ask(lambda: self._change_checkpoint(self._checkpoint.value)))
        self._status = gui.add_markdown(self._describe())
        gui.add_markdown(LEGEND)

    def _build_serve(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Serve"):
            self._random = gui.add_checkbox("Random, as in the paper's evaluation", initial_value=True)
            self._random.on_update(lambda _: self._ask(lambda: self.show.choose(self.serve)))
            self._sliders = []
            for label, least, largest, step, start, hint in SERVE_SLIDERS:
                slider = gui.add_slider(label, min=least, max=largest, step=step, initial_value=start, hint=hint)
                slider.on_update(lambda _: self._ask(self._take_sliders))
                self._sliders.append(slider)

    def _take_sliders(self) -> None:
        self._random.value = False
        self.show.choose(self.serve)

    @property
    def serve(self) -> Serve | None:
        """The serve of the sliders, or ``None`` for random serves."""
        if self._random.value:
            return None
        starts = (slider[4] for slider in SERVE_SLIDERS)
        return Serve(*(number(*each) for each in zip(self._sliders, starts, strict=True)))

    def _ask(self, request: Callable[[], None]) -> None:
        self._requests.put(request)

    def _describe(self) -> str:
        config, policy = self.show.config, self._policy
        samples = policy.counters.get("samples", 0.0)
        return f"{Path(policy.source).name}, {samples / 1e6:.1f} M samples; ball {config.ball.name}"

    # --- changes ------------------------------------------------------------------------------------------------------

    def _names(self) -> tuple[str, ...]:
        return tuple(folder.name for folder in reversed(checkpoints_of(self._policy)))

    def _change_ball(self, name: object) -> None:
        if name in self._balls:
            self._restart(self._policy, str(name))
        else:
            self._refuse(name)

    def _change_checkpoint(self, name: object) -> None:
        """Only a name that the page itself has listed: a browser may send any path."""
        if name == Path(self._policy.source).name:
            return
        if not isinstance(name, str) or name not in self._names():
            self._refuse(name)
            return
        try:
            policy = load_policy(Path(self._policy.source).with_name(name))
        except CheckpointError as error:  # the training run may have deleted it
            self._status.content = f"**{error}**"
            return
        self._restart(policy, self._ball)

    def _refuse(self, name: object) -> None:
        self._status.content = f"**{printable(str(name)[:40])} does not exist**"

    def _restart(self, policy: TaskPolicy, ball: str | None) -> None:
        """Start a new show, with a new score, for another policy or another ball."""
        chosen = [f"ball={ball}"] if ball else []
        try:
            self.show = self._make_show(policy, [*self._overrides, *chosen])
        except ConfigError as error:
            self._status.content = f"**{error}**"
            return
        self._policy, self._ball = policy, ball
        self.show.choose(self.serve)
        self._scene.forget_flight()
        self._status.content = self._describe()

    def _look_for_checkpoints(self) -> None:
        if time.monotonic() >= self._next_look:
            self._next_look = time.monotonic() + LOOK_FOR_CHECKPOINTS
            names = self._names()
            if names and names != tuple(self._checkpoint.options) and self._checkpoint.value in names:
                self._checkpoint.options = names

    # --- the loop -----------------------------------------------------------------------------------------------------

    def run(self, ended: Callable[[], bool] = lambda: False) -> None:
        """Play while a browser is connected, until ``ended`` or Ctrl-C; then close the server."""
        try:
            before = time.monotonic()
            while not ended():
                now = time.monotonic()
                self.step(min(now - before, LONGEST_FRAME))
                before = now
                time.sleep(max(0.0, FRAME - (time.monotonic() - now)))
        finally:
            stop(self.server)

    def step(self, elapsed: float) -> None:
        """Do what the browsers have asked for, and show them ``elapsed`` s more; without a browser, wait a moment."""
        while True:
            try:
                self._requests.get_nowait()()
            except Empty:
                break
        self._look_for_checkpoints()
        if self.server.get_clients():
            self.draw(self.show.advance(elapsed * number(self._time, 1.0)))
        else:
            time.sleep(IDLE)
