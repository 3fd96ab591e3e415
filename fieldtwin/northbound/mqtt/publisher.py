"""The connection of an MQTT server to its broker: it connects, publishes what waits, and connects again after a loss.

A sample leaves the backlog when the broker has confirmed that it has received it. If the connection is lost before that, the
sample is published again in the next session, with the same time.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import Desync, FieldtwinError
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.northbound.mqtt.publication import Batch, Publication, WriteRequest
from fieldtwin.twin.site.servers.broker_url import BrokerUrl
from fieldtwin.twin.thread.mqtt.session import MqttSession, broker_at, open_session
from fieldtwin.twin.thread.sparkplug_payloads import MAX_PAYLOAD

FIRST_S, LIMIT_S = 0.5, 30.0
"""The delay in seconds before the first attempt to connect again, and the longest delay."""
LASTED_S = 10.0
"""If a session lasted longer than this (seconds), the growing delay begins again at its first value."""
MAX_COMMANDS = 100
"""The largest number of commands that wait for the gateway. Further ones are refused."""


class HostOffline(FieldtwinError):
    """The primary host application went offline, so the session ends."""


class Publisher:
    """The connection of one server. `run` runs until cancelled. `decide` carries out a write and returns whether it was done.

    `next_number` returns the number of the next session, from which Sparkplug's bdSeq follows.
    """

    def __init__(
        self,
        url: BrokerUrl,
        publication: Publication,
        clock: Clock,
        next_number: Callable[[], int],
        decide: Callable[[WriteRequest], Awaitable[bool]],
    ) -> None:
        self.publication = publication
        self.error = ""
        """Why nothing is published; empty while it is."""
        self.is_connected = False
        self.sessions = self.garbled = 0
        self._url = url
        self._clock = clock
        self._next_number = next_number
        self._decide = decide
        self._work = asyncio.Event()
        self._requests: asyncio.Queue[WriteRequest] = asyncio.Queue(MAX_COMMANDS)

    def wake(self) -> None:
        """Publish what waits."""
        self._work.set()

    async def run(self) -> None:
        """Connect, publish, and connect again, until cancelled."""
        async with Nursery() as nursery:
            nursery.start(self._decide_requests(), "commands")
            await self._stay_connected()

    async def _stay_connected(self) -> None:
        backoff = Backoff(FIRST_S, LIMIT_S)
        while True:
            began_ns = self._clock.monotonic_ns()
            try:
                await self._session()
            except HostOffline as e:
                self.error = str(e)
                continue  # at once, as Sparkplug requires (3.0.0, 5.5)
            except FieldtwinError as e:
                self.error = str(e)
            finally:
                self.is_connected = False
            now_ns = self._clock.monotonic_ns()
            if now_ns - began_ns > LASTED_S * NS_PER_S:
                backoff.reset()
            await self._clock.sleep_until_ns(now_ns + int(backoff.next_s() * NS_PER_S))

    async def _session(self) -> None:
        """Run one session until it is lost or has to end."""
        publication = self.publication
        will = publication.begin(self._next_number(), self._now_ms())
        broker = await asyncio.to_thread(broker_at, self._url)  # reads files
        session = await open_session(broker, will)
        try:
            for topic in publication.subscriptions:
                await session.subscribe(topic)
            self.sessions += 1
            self.is_connected, self.error = True, ""
            self.wake()
            async with Nursery() as nursery:
                nursery.start(self._receive(session), "messages of the broker")
                nursery.start(self._send(session), "messages to the broker")
                await nursery.wait()
        finally:
            await session.aclose()

    async def _send(self, session: MqttSession) -> None:
        publication = self.publication
        while True:
            await self._work.wait()
            self._work.clear()
            if publication.must_end:
                raise HostOffline("the primary host application is offline")
            if not publication.is_ready:
                self.error = "waiting for the primary host application to be online"
                continue
            self.error = ""
            while publication.is_ready and (batch := publication.next_batch(self._now_ms())) is not None:
                await self._publish(session, batch)

    async def _publish(self, session: MqttSession, batch: Batch) -> None:
        for message in batch.messages:
            await session.publish(message)
        if any(message.qos == 0 for message in batch.messages):
            await session.confirm()
        self.publication.sent(batch)

    async def _receive(self, session: MqttSession) -> None:
        while True:
            topic, payload, _ = await session.receive()
            try:
                if len(payload) > MAX_PAYLOAD:
                    raise Desync("a message", expected=f"at most {MAX_PAYLOAD} bytes", got=str(len(payload)))
                requests = self.publication.receive(topic, payload)
            except Desync:
                self.garbled += 1
                continue
            for request in requests:
                if self._requests.full():
                    self.publication.counters["commands_refused"] += 1
                else:
                    self._requests.put_nowait(request)
            self.wake()

    async def _decide_requests(self) -> None:
        """Let the gateway decide on each command, one at a time."""
        while True:
            request = await self._requests.get()
            if not await self._decide(request):
                self.publication.counters["commands_refused"] += 1

    def _now_ms(self) -> int:
        return self._clock.utc_ns() // NS_PER_MS
