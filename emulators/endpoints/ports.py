"""Providers of the serial ports, listeners and buses at which the emulators of a field simulator can be reached.

`OsPorts` provides those of the operating system; `fieldtwin.emulators.endpoints.memory_ports` provides ones in memory. An
emulated device cannot detect the difference.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Protocol

from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.endpoints.udp_end import UdpEnd
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings

OnClient = Callable[[ByteConnection], Awaitable[None]]


class Listening(Protocol):
    """A listener. `bound` is the endpoint that is really open."""

    @property
    def bound(self) -> Endpoint: ...

    async def aclose(self) -> None: ...


class Datagrams(Listening, Protocol):
    """A bound UDP socket: see `UdpEnd`."""

    async def receive(self) -> tuple[bytes, tuple[str, int]]: ...

    async def send(self, data: bytes, peer: tuple[str, int]) -> None: ...


class CanPort(Listening, Protocol):
    """A bus that nodes of this process join."""

    async def join(self, name: str) -> CanConnection: ...

    def stats(self) -> dict[str, Any]:
        """Return the counters of the bus; empty if a different process serves it."""
        ...

    @property
    def runner(self) -> BusRunner | None:
        """Return the model of the bus; None if a different process serves it."""
        ...


class Ports(Protocol):
    """A provider of ports. Raises `EndpointBusy` or `Unreachable` if a port cannot be provided."""

    async def serial(
        self, link: Path, plant: Endpoint, pace: SerialSettings | None
    ) -> tuple[ByteConnection, Endpoint]: ...

    async def listen(self, endpoint: Endpoint, on_client: OnClient, max_clients: int) -> Listening: ...

    async def datagrams(self, endpoint: Endpoint) -> Datagrams: ...

    async def can_bus(self, endpoint: Endpoint, bitrate: int, *, paced: bool) -> CanPort: ...


class OsPorts:
    """The operating system's ports: virtual serial ports, sockets, the software CAN bus over TCP, kernel CAN interfaces."""

    async def serial(self, link: Path, plant: Endpoint, pace: SerialSettings | None) -> tuple[ByteConnection, Endpoint]:
        """Return a pty that can be opened by the path `link`, and the endpoint for that path.

        `plant` is the endpoint of the port in the system file.
        """
        end = await PtyEnd.open(link, plant, pace)
        return end, Endpoint("pty", path=str(end.link))

    async def listen(self, endpoint: Endpoint, on_client: OnClient, max_clients: int) -> SocketListener:
        return await SocketListener.open(endpoint, on_client, max_clients)

    async def datagrams(self, endpoint: Endpoint) -> UdpEnd:
        return await UdpEnd.open(endpoint)

    async def can_bus(self, endpoint: Endpoint, bitrate: int, *, paced: bool) -> CanPort:
        """Return a bus. This process serves a software bus, but only joins a kernel interface."""
        if endpoint.interface == "fieldtwin":
            return ServedBus(await SoftBusServer.open(endpoint, bitrate, paced=paced))
        return JoinedBus(endpoint, bitrate)


class ServedBus:
    """A software bus that this process serves."""

    def __init__(self, server: SoftBusServer) -> None:
        self._server = server

    @property
    def bound(self) -> Endpoint:
        return self._server.bound

    async def join(self, name: str) -> CanConnection:
        return self._server.attach(name)

    def stats(self) -> dict[str, Any]:
        return self._server.bus_stats()

    @property
    def runner(self) -> BusRunner | None:
        return self._server.runner

    async def aclose(self) -> None:
        await self._server.aclose()


class JoinedBus:
    """A bus that this process does not serve: a kernel interface, or the software bus of another process. Bit rate 0: any."""

    def __init__(self, endpoint: Endpoint, bitrate: int) -> None:
        self.bound = endpoint
        self._bitrate = bitrate

    async def join(self, name: str) -> CanConnection:
        return await open_can_end(self.bound, self._bitrate)

    def stats(self) -> dict[str, Any]:
        return {}

    @property
    def runner(self) -> BusRunner | None:
        return None

    async def aclose(self) -> None:
        """Do nothing, because the bus stays."""
