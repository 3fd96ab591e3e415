"""Two helpers on real TCP sockets for the tests of the prose: a recording relay, and an independent Modbus device.

The device shares no code with us: Modbus TCP as its specification defines it, over a table of words.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field

from fieldtwin.gateway.core.endpoint import Endpoint


@dataclass
class Crossed:
    """The recorded bytes: `there` towards the target, `back` from it."""

    port: int = 0
    there: bytearray = field(default_factory=bytearray)
    back: bytearray = field(default_factory=bytearray)

    @property
    def endpoint(self) -> Endpoint:
        return Endpoint.parse(f"tcp://127.0.0.1:{self.port}")


@contextlib.asynccontextmanager
async def relay(target: Endpoint) -> AsyncIterator[Crossed]:
    """Forward every byte to `target`, and record it."""
    crossed = Crossed()

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, kept: bytearray) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(65536):
                kept += data
                writer.write(data)
                await writer.drain()
        writer.close()

    async def client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection(target.host, target.port)
        await asyncio.gather(pump(reader, back, crossed.there), pump(there, writer, crossed.back))

    async with _serving(client) as crossed.port:
        yield crossed


@contextlib.asynccontextmanager
async def strange_device(words: dict[int, int], spoilt: Callable[[bytes], bytes] = bytes) -> AsyncIterator[Endpoint]:
    """A device with holding registers `words` (all others are 0). `spoilt` modifies the PDU of each reply."""

    def answer(pdu: bytes) -> bytes:
        function, address, count = struct.unpack(">BHH", pdu[:5])
        if function in (3, 4):
            return struct.pack(f">BB{count}H", function, 2 * count, *(words.get(address + i, 0) for i in range(count)))
        if function == 6:
            words[address] = count
            return pdu
        if function == 16:
            words.update(zip(range(address, address + count), struct.unpack(f">{count}H", pdu[6:]), strict=True))
            return pdu[:5]
        return bytes([function | 0x80, 1])

    async def client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                head = await reader.readexactly(7)
                pdu = spoilt(answer(await reader.readexactly(int.from_bytes(head[4:6]) - 1)))
                writer.write(head[:4] + (len(pdu) + 1).to_bytes(2) + head[6:] + pdu)
        writer.close()

    async with _serving(client) as port:
        yield Endpoint.parse(f"tcp://127.0.0.1:{port}")


@contextlib.asynccontextmanager
async def _serving(client: Callable[[asyncio.StreamReader, asyncio.StreamWriter], object]) -> AsyncIterator[int]:
    tasks: set[asyncio.Task[None]] = set()

    async def kept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        tasks.add(task)
        await client(reader, writer)  # type: ignore[misc]

    server = await asyncio.start_server(kept, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await server.wait_closed()
