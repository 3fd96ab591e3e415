"""A thread over TCP: one side listens, the other comes. Each datagram has its length in two bytes before it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from gateway.core.connection import ByteConnection, Client, Clients, Connector, Listen
from gateway.core.endpoint import Endpoint
from gateway.core.errors import ConnectionLost
from twin.thread_frames import Schema
from twin.thread_link import Carrier, DatagramLink

MTU = 8192
ACK_DELAY_NS = 20_000_000


class StreamLink(DatagramLink):
    """A link over a byte stream."""

    ack_delay_ns = ACK_DELAY_NS

    def __init__(self, connection: ByteConnection, schemas: Sequence[Schema]) -> None:
        super().__init__(schemas, MTU)
        self._connection = connection
        self._pending = bytearray()
        self.over = asyncio.Event()

    async def send_datagram(self, data: bytes) -> None:
        await self._connection.write(len(data).to_bytes(2) + data)

    async def receive_datagram(self) -> bytes:
        while True:
            if len(self._pending) >= 2:
                end = 2 + int.from_bytes(self._pending[:2])
                if end > 2 + MTU:
                    raise ConnectionLost(
                        "this is no thread", expected=f"frames of at most {MTU} bytes", got=str(end - 2)
                    )
                if len(self._pending) >= end:
                    data = bytes(self._pending[2:end])
                    del self._pending[:end]
                    return data
            self._pending += await self._connection.read()

    async def aclose(self) -> None:
        self.over.set()
        await self._connection.aclose()


class TcpDialler(Carrier):
    """Goes to the other side."""

    def __init__(self, endpoint: Endpoint, connector: Connector, schemas: Sequence[Schema]) -> None:
        self.name = f"thread to {endpoint}"
        self._endpoint = endpoint
        self._connector = connector
        self._schemas = schemas

    async def open(self) -> StreamLink:
        return StreamLink(await self._connector.open_bytes(self._endpoint), self._schemas)


class TcpListening(Carrier):
    """Waits for the other side. Who comes last is the one: a peer that lost its link comes again before we notice.

    ``carrier = await TcpListening.start(endpoint, TcpListener.open, schemas)``; `bound` says the port.
    """

    def __init__(self, schemas: Sequence[Schema]) -> None:
        self.name = "thread"
        self._schemas = schemas
        self._next: StreamLink | None = None
        self._came = asyncio.Event()
        self._listener: Clients | None = None

    @classmethod
    async def start(cls, endpoint: Endpoint, listen: Listen, schemas: Sequence[Schema]) -> TcpListening:
        self = cls(schemas)
        self._listener = await listen(endpoint, self._on_client, 1, lambda address: True, 0.0)
        self.name = f"thread at {self.bound}"
        return self

    @property
    def bound(self) -> Endpoint:
        assert self._listener is not None
        return self._listener.bound

    async def _on_client(self, client: Client) -> None:
        link = StreamLink(client, self._schemas)
        self._next = link
        self._came.set()
        await link.over.wait()

    async def open(self) -> StreamLink:
        while self._next is None:
            self._came.clear()
            await self._came.wait()
        link, self._next = self._next, None
        return link

    async def aclose(self) -> None:
        if self._listener is not None:
            await self._listener.aclose()
