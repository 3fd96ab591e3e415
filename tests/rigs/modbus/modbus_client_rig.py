"""A Modbus client and a device of a few lines at both ends of a wire in memory."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from support import run

from fieldtwin.gateway.core.connection import ByteConnection, RS232Connection, TCPConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import (
    ConnectionLost,
)
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc
from fieldtwin.gateway.protocols.modbus.frames.selection import Framing
from fieldtwin.gateway.wallclock import WallClock

CLOCK = WallClock()
LINE = SerialSettings(19200, "8E1")
RTU = Endpoint.parse("rtu:/dev/ttyS9?baudrate=19200&frame=8E1")
TCP = Endpoint.parse("tcp://device:502")


class MemoryEnd(ByteConnection):
    """One end of an in-memory duplex wire."""

    peer: MemoryEnd

    async def write(self, data: bytes) -> None:
        if self.lost is not None:
            raise ConnectionLost("the wire is cut", where=str(self.endpoint))
        self.peer.feed(data)

    async def aclose(self) -> None:
        self.feed_lost(closed_locally(self.endpoint))
        self.peer.feed_lost(ConnectionLost("the peer closed", where=str(self.endpoint)))


def wire(framing: Framing) -> tuple[MemoryEnd, MemoryEnd]:
    rtu = framing == "rtu"
    ends = [MemoryEnd(RS232Connection() if rtu else TCPConnection(), RTU if rtu else TCP) for _ in range(2)]
    ends[0].peer, ends[1].peer = ends[1], ends[0]
    return ends[0], ends[1]


class Device:
    """The remote end, by hand: requests are recorded with their arrival times; a test sends the answers."""

    def __init__(self, end: MemoryEnd) -> None:
        self.end = end
        self.requests: list[tuple[int, bytes]] = []
        self.answer: Callable[[bytes], Awaitable[None]] | None = None

    async def serve(self) -> None:
        while True:
            request = await self.end.read()
            self.requests.append((CLOCK.monotonic_ns(), request))
            if self.answer is not None:
                await self.answer(request)

    async def send(self, text: str) -> None:
        await self.end.write(bytes.fromhex(text))

    async def send_frame(self, text: str) -> None:
        await self.end.write(with_crc(bytes.fromhex(text)))


def with_client(
    scenario: Callable[[ModbusClient, Device], Awaitable[None]],
    framing: Framing = "rtu",
    serial: SerialSettings | None = LINE,
    timeout_s: float = 0.06,
    echo: bool = False,
) -> None:
    async def main() -> None:
        near, far = wire(framing)
        client = ModbusClient(near, CLOCK, framing=framing, serial=serial, timeout_s=timeout_s, echo=echo)
        device = Device(far)
        serving = asyncio.create_task(device.serve())
        try:
            await scenario(client, device)
        finally:
            serving.cancel()
            [ended] = await asyncio.gather(serving, return_exceptions=True)
            await client.aclose()
        assert isinstance(ended, asyncio.CancelledError | ConnectionLost), "the device stumbled"
        c = client.counters
        answered = c.broadcasts + c.replies + c.exceptions + c.timeouts + c.crc_errors + c.desyncs
        assert c.requests == answered + c.verify_failures + c.abandoned

    run(main())


def register_frame(value: int) -> str:
    return f"01 03 02 {value:04x}"


def answering(device: Device, *values: int) -> None:
    """Answer reads of one register at once, with `values` in turn."""
    left = list(values)

    async def answer(request: bytes) -> None:
        if request[0]:
            await device.send_frame(register_frame(left.pop(0)))

    device.answer = answer


def mbap_answer(device: Device) -> Callable[[bytes], Awaitable[None]]:
    async def answer(request: bytes) -> None:
        await device.send(f"{request[:2].hex()} 0000 0005 01 03 02 {request[1] * 3:04x}")

    return answer
