"""A live connection for the commissioning commands: opened by its URL, observed by `Tap` objects, closed at the end of the
context.

A command sends through the gateway's own Modbus client or CANopen master, with the same framing, silent intervals and checks
as in plant operation. This module must not depend on the purpose of a command.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.tap import TappedConnector
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection, Connector, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of, make_framer
from fieldtwin.gateway.protocols.modbus.requests.request import Request
from fieldtwin.gateway.wallclock import WallClock


@asynccontextmanager
async def modbus_at(
    url: str,
    *,
    timeout_s: float = 1.0,
    spacing_s: float = 0.0,
    echo: bool = False,
    taps: Sequence[Tap] = (),
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> AsyncIterator[ModbusClient]:
    """Yield a Modbus client at `url` (``rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1``, ``tcp://HOST:502``...).

    `timeout_s` is for each reply, `spacing_s` is the pause after every exchange (the rate limit of sweeps); `taps` observe
    everything that is sent and received. Raises `UsageError` for a URL that is not a Modbus endpoint, `Unreachable` if it cannot
    be opened.
    """
    endpoint = Endpoint.parse(url)
    framing_of(endpoint)
    clock = clock or WallClock()
    connection = await _observed(connector, taps, clock).open_bytes(endpoint)
    client = ModbusClient.at(endpoint, connection, clock, timeout_s=timeout_s, spacing_s=spacing_s, echo=echo)
    try:
        yield client
    finally:
        await client.aclose()


@asynccontextmanager
async def canopen_at(
    url: str,
    bitrate: int = 0,
    *,
    sdo_timeout_s: float = 0.5,
    taps: Sequence[Tap] = (),
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> AsyncIterator[CanopenMaster]:
    """Yield a CANopen master on the bus at `url`, already listening; it sends nothing by itself.

    `bitrate` is in bit/s; 0 is the present rate of the bus, if the adapter or simulated bus knows it. Raises `UsageError` for a
    URL that is not a CAN bus, `Unreachable` or `ConnectionLost` if the bus cannot be opened.
    """
    clock = clock or WallClock()
    async with frames_at(url, bitrate, taps=taps, connector=connector, clock=clock) as connection:
        master = CanopenMaster(connection, clock, sdo_timeout_s=sdo_timeout_s)
        async with Nursery() as nursery:
            nursery.start(master.run(), f"master at {url}")
            yield master


@asynccontextmanager
async def bytes_at(
    url: str, *, taps: Sequence[Tap] = (), connector: Connector | None = None, clock: Clock | None = None
) -> AsyncIterator[ByteConnection]:
    """Yield the byte connection at `url`, for listening only. Raises the same errors as `modbus_at`."""
    connection = await _observed(connector, taps, clock or WallClock()).open_bytes(Endpoint.parse(url))
    try:
        yield connection
    finally:
        await connection.aclose()


@asynccontextmanager
async def frames_at(
    url: str,
    bitrate: int = 0,
    *,
    taps: Sequence[Tap] = (),
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> AsyncIterator[CanConnection]:
    """Yield the frame connection of a CAN bus, for listening only. Raises the same errors as `canopen_at`."""
    endpoint = Endpoint.parse(url)
    if not endpoint.is_can:
        raise UsageError("CANopen needs a CAN bus", expected="can:socketcan/can0 or can:fieldtwin/HOST:PORT", got=url)
    connection = await _observed(connector, taps, clock or WallClock()).open_can(endpoint, bitrate)
    try:
        yield connection
    finally:
        await connection.aclose()


def frame_of(url: str, unit: int, request: Request[Any]) -> bytes:
    """Return the frame of `request` to `unit` on the endpoint `url`, with transaction ID 1: for `--dry-run`."""
    endpoint = Endpoint.parse(url)
    char_time_ns = round(endpoint.serial.char_time_s * NS_PER_S) if endpoint.is_serial else 0
    framer = make_framer(
        framing_of(endpoint), char_time_ns=char_time_ns, echo=False, strict=False, accepts_zero_id=False
    )
    return framer.begin(unit, request)


def _observed(connector: Connector | None, taps: Sequence[Tap], clock: Clock) -> Connector:
    connector = connector or OsConnector()
    return TappedConnector(connector, taps, clock) if taps else connector
