"""The acoustic channel between processes: one process serves it on a Unix socket, and modems in other processes connect.

A frame consists of a kind (one byte), a length in two bytes (big endian) and that number of bytes. A modem sends `M` (its name)
first, and `S` to transmit a packet. The server sends `A` when it has accepted the name or a packet, so that there is room for
one more packet, and `H` with each packet that the modem has received. Without the server a modem accepts and receives no packets,
and keeps running.
"""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import suppress
from pathlib import Path

from fieldtwin.emulators.wires.acoustic import AcousticMedium
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import Desync, EndpointBusy, FieldtwinError, Unreachable

ROOM = 2
"""The number of packets that a modem may send to the server before the server accepts the first of them."""
MAX_RECEIVED = 64
_LONGEST = 1024


async def _read(reader: asyncio.StreamReader) -> tuple[bytes, bytes]:
    """Read one frame, and return its kind and content. Raises `asyncio.IncompleteReadError` at the end, `Desync` for an
    invalid frame.
    """
    head = await reader.readexactly(3)
    length = int.from_bytes(head[1:])
    if length > _LONGEST:
        raise Desync("not a frame of the acoustic channel", expected=f"at most {_LONGEST} bytes", got=str(length))
    return head[:1], await reader.readexactly(length)


def _frame(kind: bytes, content: bytes = b"") -> bytes:
    return kind + len(content).to_bytes(2) + content


async def _close(writer: asyncio.StreamWriter) -> None:
    writer.close()
    with suppress(OSError):
        await writer.wait_closed()


class AcousticServer:
    """The server of the channel: ``await server.open(path)``, then ``await server.run()`` in parallel.

    Each modem has one connection."""

    def __init__(self, medium: AcousticMedium, clock: Clock) -> None:
        self._medium = medium
        self._clock = clock
        self._server: asyncio.Server | None = None
        self._writers: dict[str, asyncio.StreamWriter] = {}
        self._news = asyncio.Event()
        medium.on_send = self._news.set
        self._wanted: dict[str, deque[bytes]] = {}
        self._serving: list[asyncio.Task[None]] = []

    async def open(self, path: Path) -> None:
        """Listen on the Unix socket. Raises `EndpointBusy`."""
        path.unlink(missing_ok=True)
        try:
            self._server = await asyncio.start_unix_server(self._serve, path)
        except OSError as e:
            raise EndpointBusy(f"cannot serve the acoustic channel: {e.strerror}", where=str(path)) from e

    async def run(self) -> None:
        """Forward received packets to the modems, until cancelled."""
        while True:
            now_ns = self._clock.monotonic_ns()
            self._medium.advance(now_ns)
            for name, writer in list(self._writers.items()):
                self._hand_on(name, writer, now_ns)
            self._news.clear()
            await self._until(self._medium.next_ns)

    def _hand_on(self, name: str, writer: asyncio.StreamWriter, now_ns: int) -> None:
        wanted = self._wanted[name]
        while wanted and self._medium.transmit(name, wanted[0], now_ns):
            wanted.popleft()
            writer.write(_frame(b"A"))
        while (heard := self._medium.take(name, now_ns)) is not None:
            writer.write(_frame(b"H", heard))

    async def _until(self, t_ns: int | None) -> None:
        """Wait until an event occurs in the channel, or a modem wants to send."""
        left_s = None if t_ns is None else max(0.0, (t_ns - self._clock.monotonic_ns()) / 1e9)
        with suppress(TimeoutError):
            async with asyncio.timeout(left_s):
                await self._news.wait()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        name, me = "", asyncio.current_task()
        assert me is not None
        self._serving.append(me)
        try:
            kind, content = await _read(reader)
            name = content.decode(errors="replace")
            if kind != b"M" or name not in self._medium.counters or name in self._writers:
                return
            self._writers[name], self._wanted[name] = writer, deque()
            writer.write(_frame(b"A"))  # the modem has joined the channel
            while True:
                kind, content = await _read(reader)
                if kind == b"S" and len(self._wanted[name]) < ROOM:
                    self._wanted[name].append(content)
                    self._news.set()
        except (asyncio.IncompleteReadError, OSError, Desync):
            pass  # the modem's process has ended
        finally:
            if self._writers.get(name) is writer:
                del self._writers[name]
            await _close(writer)
            self._serving.remove(me)

    async def aclose(self) -> None:
        if self._server is not None:
            self._server.close()
        for task in (serving := list(self._serving)):
            task.cancel()
        if serving:
            await asyncio.wait(serving)
        if self._server is not None:
            await self._server.wait_closed()


class AcousticEnd:
    """A modem's end of a channel that another process serves (`fieldtwin.emulators.models.modbus.packet_link.ModemEnd`)."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.sent = self.resent = self.delivered = 0
        self._reader, self._writer = reader, writer
        self._heard: deque[bytes] = deque(maxlen=MAX_RECEIVED)
        self._under_way = 0
        self._gone = False
        self._nursery = Nursery()
        self._nursery.start(self._listen(), "water")

    @classmethod
    async def open(cls, path: Path, name: str) -> AcousticEnd:
        """Return the end of the modem `name`. Raises `Unreachable`."""
        try:
            reader, writer = await asyncio.open_unix_connection(path)
        except OSError as e:
            raise Unreachable("there is no acoustic channel", where=str(path)) from e
        try:
            writer.write(_frame(b"M", name.encode()))
            await _read(reader)
        except (OSError, asyncio.IncompleteReadError, Desync) as e:
            await _close(writer)
            raise Unreachable(f"{name} is not on the acoustic channel", where=str(path)) from e
        return cls(reader, writer)

    def submit(self, payload: bytes, now_ns: int) -> bool:
        if self._gone or self._under_way >= ROOM:
            return False
        self._writer.write(_frame(b"S", payload))
        self._under_way += 1
        self.sent += 1
        return True

    def arrived(self, now_ns: int) -> bytes | None:
        if not self._heard:
            return None
        self.delivered += 1
        return self._heard.popleft()

    async def _listen(self) -> None:
        with suppress(asyncio.IncompleteReadError, OSError, FieldtwinError):
            while True:
                kind, content = await _read(self._reader)
                if kind == b"A":
                    self._under_way -= 1
                elif kind == b"H":
                    self._heard.append(content)
        self._gone = True

    async def aclose(self) -> None:
        await self._nursery.__aexit__(None, None, None)
        await _close(self._writer)
