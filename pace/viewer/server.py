"""The server of a page: at a port of this machine alone, or behind a token. Needs the extra ``viewer``."""

from __future__ import annotations

import ipaddress
import math
import socket
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

from pace.config.extras import cure
from pace.viewer.gate import Gate
from pace.viewer.messages import listen_to_controls

LOCAL = "127.0.0.1"


class PageError(RuntimeError):
    """A page that cannot be shown; the message says why."""


def require_viewer() -> None:
    """Errors: :class:`PageError` if the packages of the page are missing."""
    try:
        import mjviser
    except ImportError as error:
        raise PageError(f"{error}: {cure('viewer')}") from error
    del mjviser


def require_port(host: str, port: int) -> None:
    """Errors: :class:`PageError` if ``port`` of ``host`` is in use or may not be opened."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((host, port), family=family).close()
    except (OSError, OverflowError) as error:
        raise PageError(
            f"port {port} of {host} cannot be opened ({error}): give another port=, or end what uses it"
        ) from error


def is_local(host: str) -> bool:
    """Whether only this machine reaches ``host``."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def open_server(host: str, port: int) -> tuple[Any, str]:
    """A viser server, and the address for the user's browser.

    If others can reach ``host``, the server itself is at another port of this machine alone, and a :class:`Gate`, with
    a token in the address, is at ``port``.

    Errors: :class:`PageError` for a port that cannot be opened.
    """
    require_port(host, port)
    if is_local(host):
        server = _viser(host, port)
        if server.get_port() != port:  # another process took it first
            stop(server)
            raise PageError(f"port {port} of {host} was taken just now: give another port=")
        return server, f"http://{host}:{port}"
    server = _viser(LOCAL, 0)
    try:
        gate = Gate(host, port, server.get_port())
    except OSError as error:
        stop(server)
        raise PageError(f"port {port} of {host} was taken just now ({error}): give another port=") from error
    named = socket.gethostname() if host in ("0.0.0.0", "::") else host
    return server, f"http://{named}:{port}/?token={gate.token}"


def _viser(host: str, port: int) -> Any:
    import viser

    with redirect_stdout(StringIO()):  # hides its banner
        server = viser.ViserServer(host=host, port=port, label="PACE", verbose=False)
    listen_to_controls(server)
    return server


def stop(server: Any) -> None:
    """Stop a server of :func:`open_server`, without its word about it."""
    with redirect_stdout(StringIO()):
        server.stop()


def number(slider: Any, start: float) -> float:
    """What a browser has set a slider to, within its ends; ``start`` for what is no number. It may send anything."""
    value = slider.value
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return start
    return float(min(max(value, slider.min), slider.max))
