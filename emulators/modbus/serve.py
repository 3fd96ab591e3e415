"""The thin asynchronous part: a connection on one side, a pure server on the other, and the wait in between.

Knows no frame format: when to read, when to write, whom to tell.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from emulators.modbus.mbap import MbapSlave
from emulators.modbus.rtu import Exchange, RtuSlave
from gateway.core.clock import NS_PER_S, Clock
from gateway.core.connection import ByteConnection, Direction
from gateway.core.errors import ConnectionLost

OnFrame = Callable[[Direction, int, bytes], None]
"""``(direction, t_ns, adu)`` for each whole ADU, directions as the gateway sees them: SENT is a request. `t_ns` is
monotonic: when the request was whole, when the last of the reply was handed over. It may not raise."""


async def serve_rtu(
    connection: ByteConnection,
    slave: RtuSlave,
    clock: Clock,
    latency_s: float = 0.0,
    on_frame: OnFrame | None = None,
) -> None:
    """Serve RTU frames on `connection` (a serial line, or a socket that stands for one) until cancelled or lost.

    `latency_s`: how long the device thinks before each reply. Returns when the connection is lost; does not close it.
    """
    try:
        while True:
            data = await _read_or_silence(connection, slave)
            now_ns = clock.monotonic_ns()
            await _reply(connection, slave.receive(data, now_ns), clock, now_ns, latency_s, on_frame)
    except ConnectionLost:
        return


async def serve_mbap(
    connection: ByteConnection,
    slave: MbapSlave,
    clock: Clock,
    latency_s: float = 0.0,
    on_frame: OnFrame | None = None,
) -> None:
    """Serve Modbus TCP on `connection` until cancelled or lost; pipelined requests are answered in order.

    One `MbapSlave` a connection. Closes the connection when the client's stream makes no sense any more (`desync`).
    """
    try:
        while slave.desync is None:
            data = await connection.read()
            now_ns = clock.monotonic_ns()
            await _reply(connection, slave.receive(data, now_ns), clock, now_ns, latency_s, on_frame)
    except ConnectionLost:
        return
    await connection.aclose()


async def _read_or_silence(connection: ByteConnection, slave: RtuSlave) -> bytes:
    """What comes next; empty after a pause that ends an unfinished frame."""
    if not slave.pending:
        return await connection.read()
    try:
        async with asyncio.timeout(slave.gap_ns / NS_PER_S):
            return await connection.read()
    except TimeoutError:
        return b""


async def _reply(
    connection: ByteConnection,
    exchanges: list[Exchange],
    clock: Clock,
    now_ns: int,
    latency_s: float,
    on_frame: OnFrame | None,
) -> None:
    if on_frame is not None:
        for exchange in exchanges:  # all of them came before any is answered
            on_frame(Direction.SENT, now_ns, exchange.heard)
    due_ns = now_ns
    for exchange in exchanges:
        if not exchange.reply:
            continue
        if latency_s > 0:
            due_ns += round(latency_s * NS_PER_S)
            await clock.sleep_until_ns(due_ns)
        await connection.write(exchange.reply)
        if on_frame is not None:
            on_frame(Direction.RECEIVED, clock.monotonic_ns(), exchange.reply)
