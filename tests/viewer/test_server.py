"""The page as anybody in a browser may treat it: values, names and messages of every kind."""

from __future__ import annotations

import math
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pace.rl.policies import TaskPolicy, load_policy
from pace.studies.page_soak import CAMERA, browser
from pace.viewer.gate import COOKIE
from pace.viewer.messages import is_value
from pace.viewer.server import PageError, is_local, number, open_server
from tests.helpers.examples import check, counts_of, json_values, st
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
    refused = pytest.importorskip("websockets.exceptions").InvalidStatus
    server, url = open_server("0.0.0.0", port)
    try:
        token = url.partition("token=")[2]
        for path, cookie in (("", ""), ("", f"{COOKIE}=guess"), ("/?token=guess", "")):
            with pytest.raises(refused, match="403"):
                connect(port, path, additional_headers={"Cookie": cookie} if cookie else {})
        with connect(port, additional_headers={"Cookie": f"{COOKIE}={token}"}) as connection:
            assert connection.recv(timeout=30)
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


def connect(port: int, path: str = "", **options: Any) -> Any:
    """A connection to the page as its own program in a browser makes it."""
    version = pytest.importorskip("viser").__version__
    protocol: list[Any] = [f"viser-v{version}"]
    to = pytest.importorskip("websockets.sync.client").connect
    return to(f"ws://127.0.0.1:{port}{path}", subprotocols=protocol, max_size=None, compression=None, **options)


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


def test_ten_browsers_see_the_page_and_those_that_leave_are_missed(page: Any, port: int) -> None:
    with ExitStack() as staying, ExitStack() as leaving:
        sizes = [stack.enter_context(browser(port)) for stack in (staying, leaving) for _ in range(5)]
        wait(30, lambda: len(page.server.get_clients()) == 10)
        seen = [each[0] for each in sizes]
        wait(30, lambda: all(each[0] > before for each, before in zip(sizes, seen, strict=True)))  # it plays for all
        leaving.close()
        wait(30, lambda: len(page.server.get_clients()) == 5)
        seen = [each[0] for each in sizes[:5]]
        wait(30, lambda: all(each[0] > before for each, before in zip(sizes, seen, strict=False)))
    wait(30, lambda: not page.server.get_clients())


def control(page: Any) -> str:
    return page._time._impl.uuid


#: Messages of a browser that is none, or that is used by somebody with bad intentions; each as bytes, text or JSON.
HOSTILE: list[Any] = [
    b"", b"\xff" * 50, b"\x81\xa4type\xa4None", "text", b"\x80", b"\xc1", b"\x93\x01\x02", b"\xc0",
    {"type": "Nothing"}, {"type": ["a"]}, {"type": None}, {1: 2}, {"type": "ShareUrlRequest"},
    {"type": "GuiUpdateMessage"}, {"type": "RunJavascriptMessage", "source": "1"}, {"type": "ViewerCameraMessage"},
    {**CAMERA, "position": "x"}, {**CAMERA, "position": None, "fov": [1]}, {**CAMERA, "wxyz": (math.nan,) * 4},
    {"type": "FileTransferStartUpload", "source_component_uuid": control, "transfer_uuid": "a", "filename": "../../x",
     "mime_type": "t", "part_count": 0, "size_bytes": 0},
    *({"type": "GuiUpdateMessage", "uuid": control, "updates": updates}
      for updates in (7, [], {}, {"props": "x"}, {"value": "x"}, {"value": None}, {"value": [1]}, {"value": True},
                      {"value": 2**64 - 1, "min": 0}, {"value": math.nan}, {"removed": True}, {"update_cb": None},
                      {"sync_cb": 1}, {"value": 0.5, "uuid": "y"})),
    {"type": "GuiUpdateMessage", "uuid": ["x"], "updates": {"value": 1.0}},
]  # fmt: skip


def test_messages_of_any_kind_change_nothing_and_are_told_in_one_line(
    page: Any, port: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pack = pytest.importorskip("msgspec").msgpack.encode
    closed = pytest.importorskip("websockets.exceptions").ConnectionClosed
    shared: list[int] = []
    monkeypatch.setattr(page.server, "request_share_url", lambda: shared.append(1))
    state = page._time._impl
    before = {name: getattr(state, name) for name in ("value", "props", "uuid", "removed", "sync_cb", "update_cb")}
    for message in HOSTILE:
        if isinstance(message, dict):
            message = pack({key: value(page) if value is control else value for key, value in message.items()})
        with connect(port) as connection, suppress(closed):
            connection.send(pack(CAMERA))
            connection.send(message)
            connection.recv(timeout=30)  # the scene, or the end of the connection
    with browser(port) as sizes:
        wait(30, lambda: sizes[0] > 10_000)  # the page still plays
        with connect(port) as connection:  # and its controls work
            connection.send(pack(CAMERA))
            connection.send(pack({"type": "GuiUpdateMessage", "uuid": control(page), "updates": {"value": 0.25}}))
            wait(30, lambda: page._time.value == 0.25)
    assert {name: getattr(state, name) for name in before} == before | {"value": 0.25}
    assert shared == []
    assert "does not speak the page's language" in caplog.text
    assert "Traceback" not in caplog.text


@counts_of(300, 3000)
def test_only_a_value_of_its_kind_is_taken(count: int) -> None:
    controls = {"flag": SimpleNamespace(value=False), "slider": SimpleNamespace(value=1.0)}
    controls |= {"choice": SimpleNamespace(value="a", options=("a", "b")), "text": SimpleNamespace(value="a")}
    gui = SimpleNamespace(_gui_input_handle_from_uuid=controls)
    kind = type("GuiUpdateMessage", (SimpleNamespace,), {})
    values = st.one_of(json_values(), st.sampled_from(["a", "b", "c", True, 0.5, math.nan, 2**64 - 1, "x" * 10**4]))
    updates = st.one_of(values.map(lambda value: {"value": value}), json_values())

    @check(count, st.one_of(st.sampled_from(sorted(controls)), json_values()), updates)
    def example(uuid: Any, updates: Any) -> None:
        if is_value(gui, kind(uuid=uuid, updates=updates)):
            ((name, value),) = updates.items()
            assert name == "value"
            assert isinstance(value, bool) == (uuid == "flag")
            assert isinstance(value, str) == (uuid in ("choice", "text"))
            assert uuid != "choice" or value in ("a", "b")
            assert uuid != "slider" or (isinstance(value, int | float) and math.isfinite(value))

    for uuid, value in (("flag", True), ("slider", 2), ("choice", "b"), ("text", "b")):
        assert is_value(gui, kind(uuid=uuid, updates={"value": value}))


@pytest.mark.parametrize(
    "path",
    ["/../pyproject.toml", "/%2e%2e/%2e%2e/pyproject.toml", "/..%2f..%2fpyproject.toml", "//etc/passwd", "/etc/passwd",
     "/..\\..\\pyproject.toml", "/./../x/../../etc/passwd", "/?checkpoint=/etc/passwd", "/%00", "/" + "a" * 5000],
)  # fmt: skip
def test_no_path_of_a_browser_is_opened(page: Any, port: int, path: str) -> None:
    with closing(socket.create_connection(("127.0.0.1", port), timeout=30)) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
        said = b"".join(iter(lambda: connection.recv(2**16), b""))
    assert b"root:" not in said
    assert b"[project]" not in said
    assert said.startswith(b"HTTP/1.1 200") == path.startswith("/?")


def test_a_checkpoint_that_is_replaced_under_the_page(page: Any, policy: TaskPolicy, port: int) -> None:
    """A training run prunes and writes; somebody copies. What is played stays until another is chosen, which is whole
    or refused."""
    own = Path(policy.source)
    folder, whole = own.parent, own.with_name("whole")
    shutil.copytree(own, whole)
    damaged, later = folder / "update_00000007", folder / "update_00000008"
    shutil.copytree(own, damaged)
    (damaged / "weights.safetensors").write_bytes(b"of something else")
    with browser(port) as sizes:
        wait(30, lambda: sizes[0] > 10_000)
        shutil.rmtree(own)  # the one that is played
        page._ask(lambda: page._change_checkpoint(damaged.name))
        wait(30, lambda: "is broken" in page._status.content)
        assert page._policy.source == str(own)
        page._ask(lambda: page._change_checkpoint("update_00000009"))
        wait(30, lambda: "does not exist" in page._status.content)
        shutil.copytree(whole, later)
        shutil.copytree(whole, own)  # of another training, for what the page knows
        page._ask(lambda: page._change_checkpoint(later.name))
        wait(30, lambda: page._policy.source == str(later))
        shutil.rmtree(later)
        seen = sizes[0]
        wait(30, lambda: sizes[0] > seen + 10_000)
        page._ask(lambda: page._change_checkpoint(own.name))
        wait(30, lambda: page._policy.source == str(own))
    for left in (damaged, whole):
        shutil.rmtree(left)
