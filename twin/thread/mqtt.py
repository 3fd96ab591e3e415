"""A thread over an MQTT broker, as Sparkplug B (the extra `mqtt`). This is the only module that imports aiomqtt."""

from __future__ import annotations

import asyncio
import logging
import ssl
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import aiomqtt

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.errors import ConnectionLost, Desync, Unreachable
from fieldtwin.gateway.store.event import Event
from fieldtwin.twin.thread.frames import Frame
from fieldtwin.twin.thread.link import Carrier, Link, Unwelcome
from fieldtwin.twin.thread.sparkplug import EdgeNode, HostApplication, MqttMessage
from fieldtwin.twin.thread.sparkplug_payloads import MAX_PAYLOAD

KEEPALIVE_S = 15
TIMEOUT_S = 10.0
QUEUED = 1000
"""Number of received messages that may wait. The client drops further ones, which will be sent again."""
ACK_DELAY_NS = 100 * NS_PER_MS
GOODBYE_S = 1.0


FAILURE = 0x80
"""SUBACK codes of this value and above are refusals (MQTT 3.9.3)."""
ACCESS = (
    "the user needs permission to read and write the topics of group and node, and STATE (docs/explanation/thread.md)"
)


class _Socket(ssl.SSLSocket):
    """A TLS socket that closes itself when the handshake fails. paho leaves it to the garbage collector."""

    def do_handshake(self, block: bool = False) -> None:
        try:
            super().do_handshake(block)
        except OSError:
            self.close()
            raise


class _LastMessage(logging.Handler):
    """A log handler that keeps the last message of paho. No other source states why a connection was lost."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.last = ""

    def emit(self, record: logging.LogRecord) -> None:
        self.last = record.getMessage().rpartition("] ")[2].partition(" (_ssl")[0]


def _refusal(e: aiomqtt.MqttError, heard: str, where: str) -> Unreachable:
    """Return the error for a session that could not be opened: `Unreachable` if a later attempt may succeed, `Unwelcome` if the
    broker refuses.
    """
    cause = e.__context__  # aiomqtt keeps the exception that paho raised
    if isinstance(cause, ssl.SSLCertVerificationError):
        hint = "ca= is the trusted authority; the certificate must name the host in the URL"
        return Unwelcome(f"the broker's certificate is refused: {cause.verify_message}", where=where, hint=hint)
    if isinstance(cause, ssl.SSLError):
        reason = (cause.reason or str(cause)).replace("_", " ").lower()
        return Unwelcome(
            f"no TLS with the broker: {reason}",
            where=where,
            hint="cert= and key= are our own certificate, if the broker requires one",
        )
    if isinstance(e, aiomqtt.MqttCodeError) and e.rc:
        hint = "the user is in the URL, the password in FIELDTWIN_MQTT_PASSWORD or FIELDTWIN_MQTT_PASSWORD_FILE"
        return Unwelcome(f"the broker refuses the connection: {str(e).partition('] ')[2] or e}", where=where, hint=hint)
    if heard:
        hint = "it may require mqtts://, or a certificate (cert= and key=)"
        return Unreachable(f"the broker ends the connection: {heard}", where=where, hint=hint)
    why = cause.strerror if isinstance(cause, OSError) and cause.strerror else str(e)
    hint = "check that the broker supports TLS on this port" if isinstance(cause, ConnectionResetError) else ""
    return Unreachable(f"the broker cannot be reached: {why}", where=where, hint=hint)


@dataclass(frozen=True, slots=True)
class Broker:
    """Address and credentials of the broker. The password is never shown."""

    host: str
    port: int = 1883
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: ssl.SSLContext | None = None

    def __str__(self) -> str:
        return f"{'mqtts' if self.tls else 'mqtt'}://{self.host}:{self.port}"


Side = EdgeNode | HostApplication


class MqttLink(Link):
    """A link of a thread: one session with the broker."""

    ack_delay_ns = ACK_DELAY_NS

    def __init__(self, client: aiomqtt.Client, side: Side, clock: Clock, where: str) -> None:
        self.side = side
        self.garbled = 0
        self._client = client
        self._clock = clock
        self._where = where
        self.quiet = (
            f"no messages through {where}: the other side is not connected, "
            f"or the user has no permission for {side.subscriptions[0]}"
        )
        self._messages: AsyncIterator[aiomqtt.Message] = aiter(client.messages)

    async def begin(self) -> None:
        """Subscribe to the topics of this side, and publish its first messages. Raises `Unwelcome` or `ConnectionLost`."""
        try:
            for topic in self.side.subscriptions:
                granted = await self._client.subscribe(topic, qos=1)
                if any(getattr(code, "value", code) >= FAILURE for code in granted):
                    raise Unwelcome(f"the broker denies the subscription to {topic}", where=self._where, hint=ACCESS)
        except aiomqtt.MqttError as e:
            raise ConnectionLost(f"the broker is gone: {e}", where=self._where) from e
        for message in self.side.hello():
            await self._publish(message)

    async def _publish(self, message: MqttMessage) -> None:
        try:
            await self._client.publish(message.topic, message.payload, qos=message.qos, retain=message.retain)
        except aiomqtt.MqttError as e:
            raise ConnectionLost(f"the broker is gone: {e}", where=self._where) from e

    async def send(self, frame: Frame) -> None:
        for message in self.side.messages(frame, self._clock.utc_ns() // NS_PER_MS):
            await self._publish(message)

    async def receive(self) -> Frame:
        while True:
            try:
                message = await anext(self._messages)
            except (aiomqtt.MqttError, StopAsyncIteration) as e:
                raise ConnectionLost(f"the broker is gone: {e}", where=self._where) from e
            payload = message.payload
            if not isinstance(payload, bytes) or len(payload) > MAX_PAYLOAD:
                self.garbled += 1
                continue
            try:
                frame = self.side.frame(message.topic.value, payload)
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
        with suppress(ConnectionLost, TimeoutError):
            async with asyncio.timeout(GOODBYE_S):
                await self._publish(self.side.will())
        with suppress(aiomqtt.MqttError):
            await self._client.__aexit__(None, None, None)


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
        if broker.tls is not None:
            broker.tls.sslsocket_class = _Socket

    async def open(self) -> MqttLink:
        b = self._broker
        side = self._make_side(self._sessions, self._clock.utc_ns() // NS_PER_MS)
        self._sessions += 1
        will = side.will()
        heard = _LastMessage()
        logger = logging.Logger("mqtt", logging.WARNING)  # logger of this session only; nothing is printed
        logger.addHandler(heard)
        client = aiomqtt.Client(
            b.host,
            b.port,
            username=b.username,
            password=b.password,
            tls_context=b.tls,
            timeout=TIMEOUT_S,
            keepalive=KEEPALIVE_S,
            max_queued_incoming_messages=QUEUED,
            logger=logger,
            will=aiomqtt.Will(will.topic, will.payload, will.qos, will.retain),
        )
        try:
            await client.__aenter__()
        except aiomqtt.MqttError as e:
            raise _refusal(e, heard.last, str(b)) from e
        link = MqttLink(client, side, self._clock, str(b))
        try:
            await link.begin()
        except BaseException:
            await link.aclose()
            raise
        return link
