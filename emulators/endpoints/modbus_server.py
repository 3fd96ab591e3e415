"""The asynchronous part of the Modbus server: it moves bytes between a connection and a server without I/O, and waits.

It does not depend on the frame format. It decides when to read, when to write and when to call `on_frame`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from fieldtwin.emulators.client_counts import ClientCounts
from fieldtwin.emulators.endpoints.faulty.streams import FaultyEnd
from fieldtwin.emulators.endpoints.ports import Datagrams
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketEnd
from fieldtwin.emulators.modbus.line import LineServer, ServedFrame
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import ByteConnection, Direction
from fieldtwin.gateway.core.endpoint import SerialSettings
from fieldtwin.gateway.core.errors import ConnectionLost

OnFrame = Callable[[Direction, int, bytes], None]
"""A function that is called with ``(direction, t_ns, adu)`` for each complete ADU. The directions are those of the gateway:
SENT is a request. `t_ns` is monotonic: when the request was complete, or when the last byte of the reply was handed over. It
may not raise.
"""

Latency = Callable[[ServedFrame], float]
"""A function that returns the processing time of a device for one exchange, in seconds."""


def as_recorded(line: SerialSettings | None = None) -> Latency:
    """Return a latency function that takes the latency from the unit, for example from a unit that replays a recording.

    A recorded latency ends with the last byte of the reply. If replies are paced on a `line`, the time that the reply
    takes there is therefore subtracted.
    """
    char_time_s = line.char_time_s if line is not None else 0.0
    return lambda exchange: max(0.0, exchange.latency_s - len(exchange.reply) * char_time_s)


async def serve_rtu(
    connection: ByteConnection,
    server: LineServer,
    clock: Clock,
    latency_s: float | Latency = 0.0,
    on_frame: OnFrame | None = None,
    *,
    echo: bool = False,
) -> None:
    """Serve RTU or ASCII frames on `connection` (a serial line, or a socket in its place) until cancelled or lost.

    `latency_s` is the processing time of the device before each reply, as a constant or a function of the exchange. With `echo`
    the client also receives the bytes that it sends, as with a two-wire adapter that receives its own frames. Returns when the
    connection is lost, without closing it.
    """
    line = connection if isinstance(connection, PtyEnd | FaultyEnd) else None
    try:
        while True:
            data = await (_read_or_silence(connection, server) if server.pending else connection.read())
            now_ns = clock.monotonic_ns()
            if echo and data:
                await connection.write(data)
            exchanges = server.receive(data, now_ns)
            if line is not None and line.paced:
                await _reply_on_line(line, exchanges, clock, now_ns, latency_s, on_frame)
            else:
                await _reply(connection.write, exchanges, clock, now_ns, latency_s, on_frame)
    except ConnectionLost:
        return


async def serve_mbap(
    connection: ByteConnection,
    server: MbapServer,
    clock: Clock,
    latency_s: float | Latency = 0.0,
    on_frame: OnFrame | None = None,
) -> None:
    """Serve Modbus TCP on `connection` until cancelled or lost; pipelined requests are answered in order.

    Each connection needs its own `MbapServer`. The connection is closed when the client's stream can no longer be parsed
    (`desync`). If the latency is zero, the reply is sent from the callback that delivers the request, which takes half
    the time.
    """
    try:
        if isinstance(connection, SocketEnd) and on_frame is None and latency_s == 0.0:
            await connection.answer_at_once(lambda data: _answer_chunk(server, data, clock))
        while server.desync is None:
            data = await connection.read()
            now_ns = clock.monotonic_ns()
            await _reply(connection.write, server.receive(data, now_ns), clock, now_ns, latency_s, on_frame)
    except ConnectionLost:
        return
    await connection.aclose()


def _answer_chunk(server: MbapServer, data: bytes, clock: Clock) -> tuple[bytes, bool]:
    """Answer a chunk without waiting. Return the replies, and whether the rest of the stream cannot be parsed."""
    return server.answer(data, clock.monotonic_ns()), server.desync is not None


async def serve_udp(
    end: Datagrams,
    server: MbapServer,
    clock: Clock,
    latency_s: float | Latency = 0.0,
    on_frame: OnFrame | None = None,
    clients: ClientCounts | None = None,
) -> None:
    """Serve Modbus TCP ADUs in datagrams until cancelled or closed.

    All clients share one `server`, which handles one request at a time. Each reply is sent in its own datagram to the sender
    of the request. A datagram that arrives twice is executed twice.
    """
    try:
        while True:
            data, peer = await end.receive()
            now_ns = clock.monotonic_ns()

            async def answer(reply: bytes, peer: tuple[str, int] = peer) -> None:
                await end.send(reply, peer)

            requests, replies = server.counts.requests, server.counts.replies
            exchanges = server.receive_datagram(data, now_ns)
            if clients is not None:
                clients.add(f"{peer[0]}:{peer[1]}", server.counts.requests - requests, server.counts.replies - replies)
            await _reply(answer, exchanges, clock, now_ns, latency_s, on_frame)
    except ConnectionLost:
        return


async def _read_or_silence(connection: ByteConnection, server: LineServer) -> bytes:
    """Return the next bytes of an unfinished frame, or b"" after a pause that ends it."""
    try:
        async with asyncio.timeout(server.gap_ns / NS_PER_S):
            return await connection.read()
    except TimeoutError:
        return b""


async def _reply(
    send: Callable[[bytes], Awaitable[None]],
    exchanges: list[ServedFrame],
    clock: Clock,
    now_ns: int,
    latency_s: float | Latency,
    on_frame: OnFrame | None,
) -> None:
    if on_frame is not None:
        _report_requests(exchanges, now_ns, on_frame)
    due_ns = now_ns
    for exchange in exchanges:
        if not exchange.reply:
            continue
        thinks_s = latency_s(exchange) if callable(latency_s) else latency_s
        if thinks_s > 0:
            due_ns += round(thinks_s * NS_PER_S)
            await clock.sleep_until_ns(due_ns)
        await send(exchange.reply)
        if on_frame is not None:
            on_frame(Direction.RECEIVED, clock.monotonic_ns(), exchange.reply)


async def _reply_on_line(
    end: PtyEnd | FaultyEnd,
    exchanges: list[ServedFrame],
    clock: Clock,
    now_ns: int,
    latency_s: float | Latency,
    on_frame: OnFrame | None,
) -> None:
    """Send the replies on a line that paces its bytes itself. The processing time of the device starts at the request's last
    character.
    """
    if on_frame is not None:
        _report_requests(exchanges, now_ns, on_frame)
    after_s = 0.0
    for exchange in exchanges:
        if exchange.reply:
            after_s += latency_s(exchange) if callable(latency_s) else latency_s
            await end.answer(exchange.reply, after_s)
            if on_frame is not None:
                on_frame(Direction.RECEIVED, clock.monotonic_ns(), exchange.reply)


def _report_requests(exchanges: list[ServedFrame], now_ns: int, on_frame: OnFrame) -> None:
    for exchange in exchanges:  # all of these frames arrived before the first of them was answered
        on_frame(Direction.SENT, now_ns, exchange.heard)
