"""A thread over an MQTT broker, as Sparkplug B (the extra `mqtt`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.store.event import Event
from fieldtwin.twin.thread.frames import Frame
from fieldtwin.twin.thread.link import Carrier, Link
from fieldtwin.twin.thread.mqtt.session import Broker, MqttSession, open_session
from fieldtwin.twin.thread.sparkplug import EdgeNode, HostApplication
from fieldtwin.twin.thread.sparkplug_payloads import MAX_PAYLOAD

ACK_DELAY_NS = 100 * NS_PER_MS
Side = EdgeNode | HostApplication


class MqttLink(Link):
    """A link of a thread: one session with the broker."""

    ack_delay_ns = ACK_DELAY_NS

    def __init__(self, session: MqttSession, side: Side, clock: Clock, where: str) -> None:
        self.side = side
        self.garbled = 0
        self._session = session
        self._clock = clock
        self.quiet = (
            f"no messages through {where}: the other side is not connected, "
            f"or the user has no permission for {side.subscriptions[0]}"
        )

    async def begin(self) -> None:
        """Subscribe to the topics of this side, and publish its first messages. Raises `Unwelcome` or `ConnectionLost`."""
        for topic in self.side.subscriptions:
            await self._session.subscribe(topic)
        for message in self.side.hello():
            await self._session.publish(message)

    async def send(self, frame: Frame) -> None:
        for message in self.side.messages(frame, self._clock.utc_ns() // NS_PER_MS):
            await self._session.publish(message)

    async def receive(self) -> Frame:
        while True:
            topic, payload, _ = await self._session.receive()
            if not payload or len(payload) > MAX_PAYLOAD:
                self.garbled += 1
                continue
            try:
                frame = self.side.frame(topic, payload)
            except Desync:
                self.garbled += 1
                continue
            if frame is not None:
                return frame

    def fit(self, tag: bytes, events: Sequence[Event]) -> int:
        return self.side.fit(events)

    def knows(self, schema: bytes) -> bool:
        """Return True: birth messages announce every name, so that this side need not know the schema beforehand."""
        return True

    async def aclose(self) -> None:
        await self._session.aclose()


class MqttCarrier(Carrier):
    """The carrier that connects to the broker.

    `make_side` is called for each session with its number, because births and deaths are counted, and with its start
    time (UTC, ms).
    """

    def __init__(self, broker: Broker, make_side: Callable[[int, int], Side], clock: Clock) -> None:
        self.name = f"thread over {broker}"
        self._broker = broker
        self._make_side = make_side
        self._clock = clock
        self._sessions = 0

    async def open(self) -> MqttLink:
        side = self._make_side(self._sessions, self._clock.utc_ns() // NS_PER_MS)
        self._sessions += 1
        link = MqttLink(await open_session(self._broker, side.will()), side, self._clock, str(self._broker))
        try:
            await link.begin()
        except BaseException:
            await link.aclose()
            raise
        return link
