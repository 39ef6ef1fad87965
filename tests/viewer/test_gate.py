"""A page in a network: only who has the token of its address gets in."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Iterator
from contextlib import closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import pytest

from pace.viewer.gate import COOKIE, Gate


class Hello(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Length", "5")
        self.end_headers()
        self.wfile.write(b"hello")

    def log_message(self, format: str, *args: object) -> None: ...


def free_port() -> int:
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        return taken.getsockname()[1]


@pytest.fixture
def gate() -> Iterator[tuple[Gate, int]]:
    inner = ThreadingHTTPServer(("127.0.0.1", 0), Hello)
    Thread(target=inner.serve_forever, daemon=True).start()
    port = free_port()
    made = Gate("127.0.0.1", port, inner.server_port)
    yield made, port
    made.close()
    inner.shutdown()


def get(port: int, path: str, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def test_the_token_opens_the_page_and_stays_in_the_browser(gate: tuple[Gate, int]) -> None:
    door, port = gate
    entered = get(port, f"/?token={door.token}")
    assert (entered.status, entered.getheader("Location")) == (303, "/")
    cookie = str(entered.getheader("Set-Cookie"))
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie  # or any site that is open in the browser could steer the page
    seen = get(port, "/", Cookie=f"other=1; {cookie.split(';')[0]}")
    assert (seen.status, seen.read()) == (200, b"hello")


@pytest.mark.parametrize("path", ["/", "/?token=", "/?token=x", "/?token=ä", "/token", "/../token", "/?a&token=AAAA"])
@pytest.mark.parametrize("cookie", ["", f"{COOKIE}=", f"{COOKIE}=no", f"not_{COOKIE}"])
def test_without_it_there_is_nothing(gate: tuple[Gate, int], path: str, cookie: str) -> None:
    answer = get(gate[1], path.replace("ä", "%C3%A4"), **({"Cookie": cookie} if cookie else {}))
    assert (answer.status, answer.read()) == (403, b"No token.\n")


@pytest.mark.parametrize("said", [b"", b"\r\n", b"\0" * 100, b"GET / HTTP/1.1\r\n", b"x" * 200_000])
def test_who_speaks_no_http_is_sent_away_and_others_are_served(gate: tuple[Gate, int], said: bytes) -> None:
    door, port = gate
    strangers = [socket.create_connection(("127.0.0.1", port)) for _ in range(10)]
    for stranger in strangers:
        stranger.sendall(said)
    seen = get(port, "/", Cookie=f"{COOKIE}={door.token}")
    assert seen.read() == b"hello"
    for stranger in strangers:
        stranger.close()
    assert get(port, "/", Cookie=f"{COOKIE}={door.token}").read() == b"hello"
