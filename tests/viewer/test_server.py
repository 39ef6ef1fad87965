"""The page as anybody in a browser may treat it: values, names and messages of every kind."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pace.rl.policies import TaskPolicy, load_policy
from pace.viewer.server import PageError, is_local, number, open_server
from tests.helpers.saved import save_run

pytest.importorskip("mjviser")


@pytest.fixture
def port() -> int:
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        return taken.getsockname()[1]


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> TaskPolicy:
    return load_policy(save_run(tmp_path_factory.mktemp("run")))


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("localhost", True), ("::1", True), ("0.0.0.0", False), ("10.0.0.1", False), ("pc", False)],
)
def test_what_is_local(host: str, local: bool) -> None:
    assert is_local(host) == local


@pytest.mark.parametrize(
    ("value", "taken"),
    [
        (2.0, 2.0), (1, 1.0), (9e9, 3.0), (-1, 0.5), (math.nan, 1.5), (-math.inf, 1.5), ("2", 1.5), (None, 1.5),
        (True, 1.5),
    ],
)  # fmt: skip
def test_a_slider_gives_a_number_within_its_ends(value: Any, taken: float) -> None:
    assert number(SimpleNamespace(value=value, min=0.5, max=3.0), 1.5) == taken


def test_a_port_in_use_is_one_line(port: int) -> None:
    with closing(socket.create_server(("127.0.0.1", port))), pytest.raises(PageError, match=f"port {port} of 127"):
        open_server("127.0.0.1", port)


def test_others_in_the_network_need_a_token(port: int) -> None:
    server, url = open_server("0.0.0.0", port)
    try:
        assert f":{port}/?token=" in url
        inner = server.get_port()
        assert inner != port
        listening = Path("/proc/net/tcp").read_text().split() if Path("/proc/net/tcp").exists() else []
        assert f"00000000:{inner:04X}" not in listening  # the server behind the gate is at no address of the network
    finally:
        server.stop()


@pytest.fixture
def page(policy: TaskPolicy, port: int) -> Iterator[Any]:
    from pace.viewer.web import Page

    shown, ended = Page(policy, ["engine.physics_dt=0.01"], ["paper", "venue"], port=port), threading.Event()
    thread = threading.Thread(target=shown.run, args=(ended.is_set,))
    thread.start()
    yield shown
    assert thread.is_alive()  # whatever came
    ended.set()
    thread.join(timeout=60)


def wait(seconds: float, condition: Any) -> None:
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        time.sleep(0.02)
    assert condition()


def test_values_that_no_control_has_change_nothing(page: Any, tmp_path: Path) -> None:
    own = page._policy.source
    for name in ("../../etc", "/etc/passwd", "", "a\0b", "x" * 10_000, None, 7, ["update"], {"a": 1}, "..", "."):
        page._ask(lambda name=name: page._change_checkpoint(name))
        page._ask(lambda name=name: page._change_ball(name))
    page._sliders[0].value = math.nan
    page._time.value = math.inf
    page._ask(page._take_sliders)
    wait(20, lambda: page.serve is not None and page._requests.empty())
    assert page._policy.source == own
    assert page.serve.speed == 5.8


def test_ten_browsers_and_messages_of_any_kind(page: Any, port: int) -> None:
    connect = pytest.importorskip("websockets.sync.client").connect
    version = pytest.importorskip("viser").__version__
    protocol: list[Any] = [f"viser-v{version}"]

    def browser() -> Any:
        return connect(f"ws://127.0.0.1:{port}", subprotocols=protocol, max_size=None, compression=None)

    browsers = [browser() for _ in range(10)]
    for index, said in enumerate(
        (b"", b"\xff" * 50, b"\x81\xa4type\xa4None", "text", b"\x80", b"\xc1", b"\x93\x01\x02")
    ):
        browsers[index].send(said)
    for each in browsers[:5]:
        each.close()  # they leave
    with browser() as last:
        assert last.recv(timeout=30)  # the scene, sent to who comes now
    handled = threading.Event()
    page._ask(handled.set)
    assert handled.wait(30)
    for each in browsers[5:]:
        each.close()
