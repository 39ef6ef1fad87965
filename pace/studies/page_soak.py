"""Hours of play on the page with a browser at it: memory and open files of the server's process."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from threading import Event, Thread
from typing import Any

from pace.rl.policies import TaskPolicy
from pace.studies.watch import Watch, require_proc
from pace.viewer.server import LOCAL, PageError
from pace.viewer.web import LONGEST_FRAME, Page

QUICK = ("engine.physics_dt=0.005",)
#: What a browser says first: where its camera is. The page plays for those that have said so.
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (-3.0, 0.0, 1.5), "fov": 1.0, "near": 0.01,
    "far": 100.0, "image_height": 600, "image_width": 800, "look_at": (0.0, 0.0, 1.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip
PATIENCE = 30.0  # s until the page has seen the browser


def free_port() -> int:
    """A port of this machine that nothing uses."""
    with closing(socket.create_server((LOCAL, 0))) as taken:
        return taken.getsockname()[1]


@contextmanager
def browser(port: int) -> Iterator[list[int]]:
    """A connection that takes whatever the page sends while the block runs; the sizes of its messages, bytes."""
    import msgspec
    import viser
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    protocol, ended, sizes = Subprotocol(f"viser-v{viser.__version__}"), Event(), [0]

    def read(connection: Any) -> None:
        while not ended.is_set():
            try:
                sizes[0] += len(connection.recv(timeout=1.0))
            except TimeoutError:
                continue
            except ConnectionClosed:
                return

    address = f"ws://{LOCAL}:{port}"
    with connect(address, subprotocols=[protocol], max_size=None, compression=None) as connection:
        reader = Thread(target=read, args=(connection,), daemon=True)
        reader.start()
        connection.send(msgspec.msgpack.encode(CAMERA))
        try:
            yield sizes
        finally:
            ended.set()
            reader.join()


def watch_page(policy: TaskPolicy, hours: float, interval: float = 1.0) -> tuple[Watch, int]:
    """Play for ``hours`` of the robot's time, as fast as this machine does; the progress is in s.

    Returns also the bytes that the browser has got.

    Errors: :class:`pace.viewer.server.PageError` without the extra ``viewer``.
    """
    require_proc()
    port = free_port()
    page = Page(policy, list(QUICK), ["paper"], port=port)
    watch = Watch(os.getpid(), interval=interval)
    try:
        with browser(port) as sizes:
            _wait_for_browser(page)
            for number in range(round(3600.0 * hours / LONGEST_FRAME)):
                page.step(LONGEST_FRAME)
                watch.sample((number + 1) * LONGEST_FRAME)
        return watch, sizes[0]
    finally:
        page.server.stop()


def _wait_for_browser(page: Page) -> None:
    deadline = time.monotonic() + PATIENCE
    while not page.server.get_clients():
        if time.monotonic() > deadline:
            raise PageError("the page does not see its browser: another version of viser?")
        time.sleep(0.05)
