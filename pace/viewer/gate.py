"""The door of a page that others in the network can reach: whoever has the token may enter."""

from __future__ import annotations

import asyncio
import hmac
import re
import secrets
import socket
from threading import Event, Thread

SECONDS_TO_ASK = 10.0  # for the head of a request
COOKIE = "pace_token"
REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\nNo token.\n"
BUFFER = 2**16


class Gate:
    """Passes connections on to a server of this machine if their first request has the token.

    The token comes in the address (``/?token=...``); the browser then has it in a cookie, which no other site can use.

    Attributes: ``token``.

    Args: host, port: to listen on; inner: port of the server. Errors: ``OSError`` for a port that cannot be opened.
    """

    def __init__(self, host: str, port: int, inner: int) -> None:
        self.token = secrets.token_urlsafe(16)
        self._inner = inner
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        self._socket = socket.create_server((host, port), family=family)
        self._loop, self._ready = asyncio.new_event_loop(), Event()
        Thread(target=self._run, daemon=True).start()
        self._ready.wait()

    def close(self) -> None:
        """Listen no longer, and end all connections."""
        self._loop.call_soon_threadsafe(self._loop.stop)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(asyncio.start_server(self._enter, sock=self._socket))
        self._ready.set()
        self._loop.run_forever()
        left = asyncio.all_tasks(self._loop)
        for task in left:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
        self._socket.close()
        self._loop.close()

    async def _enter(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), SECONDS_TO_ASK)
            if self._is(rb"\A\w+ [^ ]*[?&]token=([\w-]+)", head):
                cookie = f"Set-Cookie: {COOKIE}={self.token}; HttpOnly; SameSite=Strict\r\n"
                writer.write(f"HTTP/1.1 303 See Other\r\nLocation: /\r\n{cookie}Connection: close\r\n\r\n".encode())
            elif self._is(rb"(?im)^cookie:.*\b" + COOKIE.encode() + rb"=([\w-]+)", head):
                await self._pass_on(head, reader, writer)
            else:
                writer.write(REFUSED)
            await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # a browser that leaves, or no browser
        finally:
            writer.close()

    def _is(self, pattern: bytes, head: bytes) -> bool:
        found = re.search(pattern, head)
        return found is not None and hmac.compare_digest(found[1], self.token.encode())

    async def _pass_on(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inside, outside = await asyncio.open_connection("127.0.0.1", self._inner)
        try:
            outside.write(head)
            ways = {asyncio.create_task(_copy(reader, outside)), asyncio.create_task(_copy(inside, writer))}
            done, left = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for task in left:
                task.cancel()
            await asyncio.gather(*done, *left, return_exceptions=True)
        finally:
            outside.close()


async def _copy(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    while data := await source.read(BUFFER):
        target.write(data)
        await target.drain()
