"""A small HTTP server for one page, ``GET /metrics``. It reads no body, closes each connection after its response, and does not
depend on the page's content.

Limits: `MOST_CLIENTS` at a time, `MOST_HEAD` bytes of request, `PATIENCE_S` for all of it. It has no authentication and no TLS,
since Prometheus scrapes a separate network; so it listens on loopback by default.
"""

from __future__ import annotations

import asyncio
import errno
import re
from collections.abc import Callable

from fieldtwin.gateway.core.errors import EndpointBusy, Unreachable, UsageError
from fieldtwin.service.exposition import CONTENT_TYPE

MOST_CLIENTS = 16
MOST_HEAD = 8192
PATIENCE_S = 5.0

_PLACE = re.compile(r"^(?:(?P<host>\[[0-9A-Fa-f:.]+\]|[^\s:\[\]]*):)?(?P<port>[0-9]{1,5})$")


def parse_place(text: str) -> tuple[str, int]:
    """Parse ``HOST:PORT``, ``:PORT`` or ``PORT``; the default host is 127.0.0.1. Port 0 is any free port."""
    found = _PLACE.match(text)
    if found is None or int(found["port"]) > 65535:
        raise UsageError("the address of the metrics", expected="HOST:PORT such as 127.0.0.1:9464", got=text)
    return (found["host"] or "127.0.0.1").strip("[]"), int(found["port"])


class MetricsServer:
    """An HTTP server that returns the result of `page()`. `served` and `refused` count its requests.

    Call ``await open(host, port)`` to start it and ``await aclose()`` to stop it.
    """

    def __init__(self, page: Callable[[], str]) -> None:
        self._page = page
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self.served = 0
        self.refused = 0

    async def open(self, host: str, port: int) -> str:
        """Start listening and return the URL. Raises `EndpointBusy` if the address is in use, `Unreachable` if it cannot be
        bound.
        """
        try:
            self._server = await asyncio.start_server(self._serve, host, port, limit=MOST_HEAD)
        except OSError as e:
            kind = EndpointBusy if e.errno == errno.EADDRINUSE else Unreachable
            raise kind("cannot serve metrics at this address", where=f"{host}:{port}", hint=e.strerror or str(e)) from e
        at = self._server.sockets[0].getsockname()
        return f"http://{f'[{at[0]}]' if ':' in at[0] else at[0]}:{at[1]}/metrics"

    async def aclose(self) -> None:
        """Stop listening and close the connections that are being served."""
        if self._server is None:
            return
        self._server.close()
        clients = list(self._clients)
        for task in clients:
            task.cancel()
        await asyncio.gather(*clients, return_exceptions=True)
        await self._server.wait_closed()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is None or len(self._clients) >= MOST_CLIENTS:
            self.refused += 1
            writer.close()
            return
        self._clients.add(task)
        try:
            async with asyncio.timeout(PATIENCE_S):
                head = await reader.readuntil(b"\r\n\r\n")
                writer.write(self._answer(head))
                await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            self.refused += 1  # the client has gone, is too slow, or does not speak HTTP: no reply is possible
        except asyncio.CancelledError:
            pass  # this server is being closed
        finally:
            self._clients.discard(task)
            writer.close()

    def _answer(self, head: bytes) -> bytes:
        words = head.split(b"\r\n", 1)[0].split(b" ")
        if len(words) != 3 or not words[2].startswith(b"HTTP/1."):
            return self._refusal("400 Bad Request", "this is HTTP/1.1")
        method, path = words[0], words[1].split(b"?", 1)[0]
        if method not in (b"GET", b"HEAD"):
            return self._refusal("405 Method Not Allowed", "GET /metrics", "Allow: GET, HEAD\r\n")
        if path != b"/metrics":
            return self._refusal("404 Not Found", "the only page is /metrics")
        self.served += 1
        return _response("200 OK", self._page(), CONTENT_TYPE, with_body=method == b"GET")

    def _refusal(self, status: str, text: str, extra: str = "") -> bytes:
        self.refused += 1
        return _response(status, text + "\n", "text/plain; charset=utf-8", extra=extra)


def _response(status: str, text: str, kind: str, *, with_body: bool = True, extra: str = "") -> bytes:
    body = text.encode()
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n{extra}Connection: close\r\n\r\n"
    )
    return head.encode() + (body if with_body else b"")
