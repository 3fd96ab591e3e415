"""A Modbus RTU client on a serial line that sends requests to the gateway: the gateway acts as one or more servers on
it.

A reply on a serial line does not identify its request. A client that sends something else before it has received its answer
has given up waiting. The gateway then never sends the answer, because the client would take it for the answer to the next
request.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import asdict, dataclass

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import ByteConnection, Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable
from fieldtwin.gateway.protocols.modbus.server.line import LineRequest, RtuRequests
from fieldtwin.gateway.runtime.bridge.policy import LINE
from fieldtwin.gateway.runtime.bridge.tcp import Answer, Ask, Caller
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.gateway.runtime.gateway_status import FrontStatus


@dataclass
class BridgeLineCounters:
    """Counters: all frames, requests to unit IDs for which the gateway answers, late answers, and bytes outside of frames."""

    frames: int = 0
    requests: int = 0
    too_late: int = 0
    noise_bytes: int = 0


class LineFront:
    """A serial line, which runs until cancelled; a lost port is opened again.

    `ours` returns whether the gateway answers for a unit ID.
    """

    def __init__(
        self, endpoint: Endpoint, connector: Connector, ask: Ask, ours: Callable[[int], bool], clock: Clock
    ) -> None:
        self.endpoint = endpoint
        self.counters = BridgeLineCounters()
        self.connected = False
        self.error = ""
        self._connector = connector
        self._ask = ask
        self._ours = ours
        self._clock = clock
        self._caller = Caller(str(endpoint), LINE)
        self._answering: asyncio.Task[None] | None = None

    @property
    def bound(self) -> Endpoint | None:
        """Return the serial line while it is open, else None."""
        return self.endpoint if self.connected else None

    def status(self) -> FrontStatus:
        """Return whether the line is open, and its counters."""
        listening = str(self.endpoint) if self.connected else None
        return FrontStatus(listening=listening, error=self.error, counters=asdict(self.counters))

    async def run(self) -> None:
        """Open the line and answer its client until cancelled. A lost line is opened again."""
        backoff = Backoff(0.25, 5.0)
        while True:
            try:
                connection = await self._connector.open_bytes(self.endpoint)
            except Unreachable as e:
                self.error = str(e)
            else:
                self.connected, self.error = True, ""
                backoff.reset()
                try:
                    await self._listen(connection)
                except ConnectionLost as e:
                    self.error = str(e)
                finally:
                    self.connected = False
                    await self._give_up()
                    await connection.aclose()
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + int(backoff.next_s() * NS_PER_S))

    async def _listen(self, connection: ByteConnection) -> None:
        ours = [unit for unit in range(256) if self._ours(unit)]
        line = RtuRequests(round(self.endpoint.serial.char_time_s * NS_PER_S), ours)
        while True:
            data, noise_bytes = await self._next(connection, line), line.noise_bytes
            requests = line.feed(data) if data else line.silence()
            self.counters.frames += len(requests)
            self.counters.noise_bytes += line.noise_bytes - noise_bytes
            for request in requests:
                await self._give_up()
                if self._ours(request.unit):
                    self.counters.requests += 1
                    answer = self._ask(self._caller, request.unit, request.pdu)
                    reply = self._reply(connection, request, answer, self._clock.monotonic_ns() + line.t35_ns)
                    self._answering = asyncio.get_running_loop().create_task(reply, name="answer to a line")

    async def _next(self, connection: ByteConnection, line: RtuRequests) -> bytes:
        """Return the next bytes, or b"" after a silence that ends an unfinished frame."""
        if not line.pending:
            return await connection.read()
        try:
            async with asyncio.timeout(line.gap_ns / NS_PER_S):
                return await connection.read()
        except TimeoutError:
            return b""

    async def _reply(self, connection: ByteConnection, request: LineRequest, answer: Answer, not_before: int) -> None:
        try:
            pdu = await answer if isinstance(answer, asyncio.Future) else answer
        finally:
            if isinstance(answer, asyncio.Future):
                answer.cancel()
        if pdu is None or request.unit == 0:
            return
        await self._clock.sleep_until_ns(not_before)  # SL 2.5.1.1: 3.5 characters of silence between frames
        try:
            await connection.write(request.reply(pdu))
        except ConnectionLost:
            pass  # the task that reads the line gets the same error

    async def _give_up(self) -> None:
        """Cancel a pending answer, because the client has given up waiting for it."""
        task, self._answering = self._answering, None
        if task is None or task.done():
            return
        self.counters.too_late += 1
        task.cancel()
        await asyncio.wait([task])
