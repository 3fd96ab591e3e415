"""A thread over TCP: one side listens, the other connects. Each datagram is preceded by its length in two bytes.

A listening side serves one connecting side, its follower. A connecting side sends an identifier that it chose, so that the
listening side recognises it after a lost link and admits it again immediately. A different follower is admitted if the first
one no longer answers; otherwise the listening side answers that it already has a follower. These control messages begin with
F0h, which no frame of a thread does, and are not passed on by a link.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Sequence
from contextlib import suppress

from fieldtwin.gateway.core.connection import ByteConnection, Client, Clients, Connector, Listen
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable
from fieldtwin.twin.thread.frames import Schema
from fieldtwin.twin.thread.link import Carrier, DatagramLink, Unwelcome

MTU = 8192
ACK_DELAY_NS = 20_000_000
WHO, HERE, TAKEN, PING, PONG = (b"\xf0" + word for word in (b"WHO", b"HERE", b"TAKEN", b"PING", b"PONG"))
WHO_BYTES = 8
SAYS_WITHIN_S = 1.0
"""Seconds within which a connecting side must identify itself."""
ANSWERS_WITHIN_S = 2.0
"""Seconds within which a connected side must answer a PING."""
LET_IN_WITHIN_S = SAYS_WITHIN_S + ANSWERS_WITHIN_S + 1.0
MOST_WAITING = 8


class StreamLink(DatagramLink):
    """A link over a byte stream, such as a TCP connection."""

    ack_delay_ns = ACK_DELAY_NS

    def __init__(self, connection: ByteConnection, schemas: Sequence[Schema]) -> None:
        super().__init__(schemas, MTU)
        self._connection = connection
        self._pending = bytearray()
        self._held: bytes | None = None
        """A frame that arrived while a control message was expected."""
        self._heard = asyncio.Event()
        self.who = b""
        """The identifier that the other side has sent, if any."""
        self.read = False
        """Whether the thread has begun to read from this link."""
        self.over = asyncio.Event()

    async def send_datagram(self, data: bytes) -> None:
        await self._connection.write(len(data).to_bytes(2) + data)

    async def receive_datagram(self) -> bytes:
        while True:
            frame, self._held = self._held, None
            if frame is None:
                frame = await self._whole()
                self._heard.set()
            if not await self._word(frame):
                return frame

    async def _word(self, data: bytes) -> bool:
        """Process a control message and return whether `data` was one.

        Raises `Unwelcome` if the other side refuses this one.
        """
        if data.startswith(TAKEN):
            raise Unwelcome(
                f"another shadow or twin already follows this thread: {data.removeprefix(TAKEN).decode(errors='replace')}",
                where=str(self._connection.endpoint),
                hint="stop it first, or use a broker (mqtt://), which serves several at a time",
            )  # fmt: skip
        if data == PING:
            await self.send_datagram(PONG)
        elif data.startswith(WHO):
            self.who = data.removeprefix(WHO)
        return data[:1] == WHO[:1]

    async def introduce(self, who: bytes) -> None:
        """Send this side's identifier, and wait until it is admitted. Raises `Unwelcome`."""
        await self.send_datagram(WHO + who)
        await self._first(LET_IN_WITHIN_S)

    async def introduced(self) -> None:
        """Wait until the other side has identified itself, has sent a different frame, or has exceeded `SAYS_WITHIN_S`."""
        await self._first(SAYS_WITHIN_S)

    async def _first(self, within_s: float) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                data = await self._whole()
                if not await self._word(data):
                    self._held = data

    async def answers(self) -> bool:
        """Send a PING and return whether anything arrives within `ANSWERS_WITHIN_S`. Before a thread reads, return whether the
        link is open.
        """
        if not self.read or self._connection.lost is not None:
            return self._connection.lost is None
        self._heard.clear()
        try:
            async with asyncio.timeout(ANSWERS_WITHIN_S):
                await self.send_datagram(PING)
                await self._heard.wait()
        except (TimeoutError, Unreachable):
            return False
        return True

    async def _whole(self) -> bytes:
        while True:
            if len(self._pending) >= 2:
                end = 2 + int.from_bytes(self._pending[:2])
                if end > 2 + MTU:
                    raise ConnectionLost(
                        "this is not a thread", expected=f"frames of at most {MTU} bytes", got=str(end - 2)
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
    """The carrier that connects to the other side."""

    def __init__(self, endpoint: Endpoint, connector: Connector, schemas: Sequence[Schema]) -> None:
        self.name = f"thread to {endpoint}"
        self._endpoint = endpoint
        self._connector = connector
        self._schemas = schemas
        self._who = secrets.token_bytes(WHO_BYTES)

    async def open(self) -> StreamLink:
        link = StreamLink(await self._connector.open_bytes(self._endpoint), self._schemas)
        try:
            await link.introduce(self._who)
        except BaseException:
            await link.aclose()
            raise
        return link


class TcpListening(Carrier):
    """The carrier that waits for the other side.

    A peer that lost its link may connect again before this side has noticed the loss. `refused` counts other peers that were
    refused.

    ``carrier = await TcpListening.start(endpoint, TcpListener.open, schemas)``; `bound` is the endpoint with its port.
    """

    def __init__(self, schemas: Sequence[Schema]) -> None:
        self.name = "thread"
        self._schemas = schemas
        self._next: StreamLink | None = None
        self._there: StreamLink | None = None
        """The link of the connected follower, whether or not a thread reads from it yet. `_where` is its address."""
        self._where = ""
        self._deciding = asyncio.Lock()
        self.refused = 0
        self._came = asyncio.Event()
        self._listener: Clients | None = None

    @classmethod
    async def start(cls, endpoint: Endpoint, listen: Listen, schemas: Sequence[Schema]) -> TcpListening:
        self = cls(schemas)
        self._listener = await listen(endpoint, self._on_client, MOST_WAITING, lambda address: True, 0.0)
        self.name = f"thread at {self.bound}"
        return self

    @property
    def bound(self) -> Endpoint:
        assert self._listener is not None
        return self._listener.bound

    async def _on_client(self, client: Client) -> None:
        link = StreamLink(client, self._schemas)
        with suppress(Unreachable):  # the client left before it identified itself
            await link.introduced()
            async with self._deciding:
                there = self._there
                if there is not None and not there.over.is_set():
                    if link.who != there.who and await there.answers():
                        self.refused += 1
                        await link.send_datagram(TAKEN + self._where.encode())
                        return
                    await there.aclose()
                await link.send_datagram(HERE)
                self._there = self._next = link
                self._where = f"{client.peer}:{client.peer_port}"
            self._came.set()
            await link.over.wait()

    async def open(self) -> StreamLink:
        while self._next is None:
            self._came.clear()
            await self._came.wait()
        link, self._next = self._next, None
        link.read = True
        return link

    async def aclose(self) -> None:
        if self._listener is not None:
            await self._listener.aclose()
