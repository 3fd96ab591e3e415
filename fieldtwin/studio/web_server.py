"""A web server on a socket: uvicorn, with a bound on its connections and messages, and without its signal handlers."""

from __future__ import annotations

import asyncio
import socket
import ssl
from contextlib import nullcontext
from pathlib import Path

import uvicorn
from starlette.types import ASGIApp

from fieldtwin.gateway.core.errors import EndpointBusy, FileInvalid, Unreachable, os_reason

CLOSES_WITHIN_S = 2
MOST_WEBSOCKET_BYTES = 65_536
"""Largest message of a WebSocket's client. The interface ignores these messages."""


class WebServer:
    """The server of one application: `start`, then `wait` until `stop` was called, and in any case `aclose`.

    `certificate` and `key` are PEM files for HTTPS. Requests on more than `most_connections` connections are answered with 503.
    """

    def __init__(
        self,
        app: ASGIApp,
        listener: socket.socket,
        most_connections: int,
        certificate: Path | None = None,
        key: Path | None = None,
        websockets: bool = True,
    ) -> None:
        self._listener = listener
        self._certificate = certificate
        config = uvicorn.Config(
            app,
            log_config=None,
            log_level="critical",
            access_log=False,
            server_header=False,
            lifespan="on",
            ws="websockets-sansio" if websockets else "none",
            ws_max_size=MOST_WEBSOCKET_BYTES,
            limit_concurrency=most_connections,
            timeout_graceful_shutdown=CLOSES_WITHIN_S,
            ssl_certfile=str(certificate) if certificate else None,
            ssl_keyfile=str(key) if key else None,
        )
        self._config = config
        self._server = _Server(config)
        self._running: asyncio.Future[None] | None = None

    @property
    def port(self) -> int:
        """Return the port at which the server listens."""
        return int(self._listener.getsockname()[1])

    @property
    def requests(self) -> int:
        """Return the number of requests so far."""
        return self._server.server_state.total_requests

    @property
    def clients(self) -> list[str]:
        """Return the connected clients as HOST:PORT."""
        peers = [getattr(connection, "client", None) for connection in self._server.server_state.connections]
        return [f"{peer[0]}:{peer[1]}" for peer in peers if peer is not None]

    async def start(self) -> None:
        """Return when the server accepts connections. Raises `FileInvalid` for unusable TLS files, and `Unreachable`."""
        try:
            self._config.load()
        except (ssl.SSLError, OSError) as e:
            raise FileInvalid(
                f"the certificate or its key cannot be used: {e}", path=str(self._certificate), expected="PEM files"
            ) from e
        self._running = asyncio.ensure_future(self._server.serve(sockets=[self._listener]))
        while not self._server.started and not self._running.done():
            await asyncio.sleep(0.01)
        if self._running.done():
            self._running.result()
            raise Unreachable("the server did not start", where=str(self._listener.getsockname()))

    async def wait(self) -> None:
        """Wait until the server has stopped."""
        if self._running is not None:
            await asyncio.wait([self._running])  # a cancelled caller must not cancel the server's own shutdown
            self._running.result()

    def stop(self) -> None:
        """Stop the server; open connections end within `CLOSES_WITHIN_S` seconds."""
        self._server.should_exit = True

    async def aclose(self) -> None:
        """Stop the server, wait for its end, and close the socket."""
        self.stop()
        if self._running is not None:
            await asyncio.gather(self._running, return_exceptions=True)
        self._listener.close()


class _Server(uvicorn.Server):
    """A server whose signals are handled by the caller."""

    def install_signal_handlers(self) -> None:
        return None

    def capture_signals(self):  # type: ignore[no-untyped-def]
        return nullcontext()


def listening_socket(host: str, port: int, hint: str = "") -> socket.socket:
    """Return a socket that listens; port 0 chooses a free one. Raises `EndpointBusy`, with `hint`, or `Unreachable`."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(128)
    except OSError as e:
        listener.close()
        where = f"{host}:{port}"
        if e.errno in (98, 48):
            raise EndpointBusy("another program listens there", where=where, hint=hint) from e
        raise Unreachable(f"cannot listen: {os_reason(e)}", where=where) from e
    return listener
