"""The virtual port that a client under test opens. A case can remove it, restore it under its name, and hold it exclusively."""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress
from pathlib import Path

from fieldtwin.conformance.clients.modbus.hostile_server import HostileServer
from fieldtwin.conformance.clients.modbus.setup import Unplug
from fieldtwin.emulators.endpoints.ports import OsPorts
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import Unreachable

with suppress(ImportError):  # Windows has no pseudo-terminals
    import fcntl
    import termios


class PtyLine:
    """The virtual port of a client under test, on which the server `stage` answers. Create it with ``line = await
    PtyLine.open(listen, stage)``, serve with ``await line.run()`` until cancelled, and end it with ``await line.aclose()``.
    """

    def __init__(self, listen: Endpoint, stage: HostileServer, port: ByteConnection, named: Endpoint) -> None:
        self.named = named
        self._listen = listen
        self._stage = stage
        self._port = port
        self._unplugged: Unplug | None = None
        stage.unplug = self._unplug

    @classmethod
    async def open(cls, listen: Endpoint, stage: HostileServer) -> PtyLine:
        """Create the port at `listen`. Raises the errors of `PtyEnd.open`."""
        return cls(listen, stage, *await _open(listen))

    @staticmethod
    def traits() -> frozenset[str]:
        """Return the features of this kind of port that a case may need (see `ModbusCase.framings`).

        Root has no ``lock``: a port that is held exclusively (tty_ioctl(4), TIOCEXCL) still opens for root.
        """
        return frozenset({"port"} if os.geteuid() == 0 else {"port", "lock"})

    async def run(self) -> None:
        """Serve the client; when a case unplugs the port, restore it as the case states, and continue to serve."""
        plugged_in_again = False
        while True:
            await self._stage.serve(self._port, plugged_in_again=plugged_in_again)
            plugged_in_again = True
            step, self._unplugged = self._unplugged, None
            if step is None:
                raise Unreachable("the virtual serial port is gone", where=str(self._listen))
            try:
                Path(self._listen.path).unlink(missing_ok=True)
                await asyncio.sleep(step.out_s)
                self._port, self.named = await _open(self._listen)
                if step.held_s:
                    await _held(self.named.path, step.held_s)
            finally:
                self._stage.last_ns = self._stage.now_ns()
                self._stage.pending -= 1

    async def aclose(self) -> None:
        await self._port.aclose()

    def _unplug(self, step: Unplug) -> None:
        """Stop serving the client, so that `run` removes the port and restores it as `step` states."""
        self._stage.pending += 1
        self._unplugged = step
        self._closing = asyncio.get_running_loop().create_task(self._port.aclose(), name="unplugging")


async def _open(listen: Endpoint) -> tuple[ByteConnection, Endpoint]:
    pace: SerialSettings | None = listen.serial if listen.param("baudrate") else None
    return await OsPorts().serial(Path(listen.path), listen, pace)


async def _held(path: str, for_s: float) -> None:
    """Hold the port for `for_s` seconds, so that no other process can open it."""
    held = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.ioctl(held, termios.TIOCEXCL)
        await asyncio.sleep(for_s)
        fcntl.ioctl(held, termios.TIOCNXCL)
    finally:
        os.close(held)
