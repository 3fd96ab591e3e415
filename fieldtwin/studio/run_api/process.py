"""The process of a server of kind `http`: ``python -m fieldtwin.studio.run_api.process CONFIG.json``.

It queries gateway, PLC and field simulator through their control channels and reads the process image, as Studio does. So
no client delays the polling of a bus, and the gateway checks and audits each write.
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.runtime.gateway_status import ServerStatus
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.northbound.process_config import ServerProcessConfig, server_of
from fieldtwin.northbound.status_report import report_status
from fieldtwin.studio.run_api.app import access_to, run_application
from fieldtwin.studio.web_server import WebServer, listening_socket
from fieldtwin.twin.plant.child_main import child_main
from fieldtwin.twin.site.resolved import read_resolved
from fieldtwin.twin.site.servers.serving_http import HttpServeConfig
from fieldtwin.twin.site.system import System

LISTEN_EVERY_S = 1.0
"""Pause in seconds before the server tries again to listen at an address that is taken, or to read its files."""


class HttpProcess:
    """One HTTP server for the run in `run_dir`, which serves until it is stopped."""

    def __init__(self, config: ServerProcessConfig) -> None:
        [system] = read_resolved(config.resolved)
        assert isinstance(system, System)
        server = server_of(system, config)
        assert isinstance(server, HttpServeConfig)
        self._config = server
        self._run_dir = Path(config.run_dir)
        self._clock = WallClock()
        self._server: WebServer | None = None
        self._error = ""

    async def run(self) -> int:
        stop = stop_signal()
        async with Nursery() as nursery:
            nursery.start(report_status(self._run_dir, self._config.name, self._status, self._clock), "status reports")
            serving = nursery.start(self._serve(), "server")
            stopping = asyncio.ensure_future(stop.wait())
            await asyncio.wait([serving, stopping], return_when=asyncio.FIRST_COMPLETED)
            stopping.cancel()
            if serving.done():
                serving.result()
        return 0

    async def _serve(self) -> None:
        server = await self._started()
        try:
            self._server = server
            await server.wait()
        finally:
            self._server = None
            await server.aclose()

    async def _started(self) -> WebServer:
        while True:
            try:
                server = await self._start()
            except FieldtwinError as e:
                self._error = str(e)
            else:
                self._error = ""
                return server
            await asyncio.sleep(LISTEN_EVERY_S)

    async def _start(self) -> WebServer:
        config = self._config
        listener = listening_socket(config.host, config.port)
        try:
            access = access_to(config, listener.getsockname()[1])
        except FieldtwinError:
            listener.close()
            raise
        app = run_application(access, self._clock, self._run_dir.name, config.name)
        server = WebServer(app, listener, config.clients, config.certificate, config.key)
        try:
            await server.start()
        except BaseException:
            await server.aclose()
            raise
        return server

    def _status(self) -> ServerStatus:
        server = self._server
        return ServerStatus(
            listening=self._config.url_at(server.port) if server is not None else None,
            error=self._error,
            counters={"requests": server.requests} if server is not None else {},
            clients=server.clients if server is not None else [],
            kind=self._config.kind,
        )


def main(argv: list[str]) -> int:
    """Run the process; an error is printed to stderr as one line."""
    return child_main(argv, ServerProcessConfig, lambda config: HttpProcess(config).run())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
