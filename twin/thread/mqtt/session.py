"""A session with an MQTT broker (the extra `mqtt`). This is the only module that imports aiomqtt."""

from __future__ import annotations

import asyncio
import logging
import os
import ssl
from collections.abc import AsyncIterator, Coroutine
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlencode

import aiomqtt

from fieldtwin.gateway.connections.sockets.tls import client_context
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable, UsageError
from fieldtwin.twin.site.servers.broker_url import PASSWORD, BrokerUrl
from fieldtwin.twin.thread.link import Unwelcome
from fieldtwin.twin.thread.mqtt.message import MqttMessage

R = TypeVar("R")

KEEPALIVE_S = 15
TIMEOUT_S = 10.0
QUEUED = 1000
"""Number of received messages that may wait. The client drops further ones."""
GOODBYE_S = 1.0
FAILURE = 0x80
"""SUBACK codes of this value and above are refusals (MQTT 3.9.3)."""
ACCESS = "the user needs permission for the topics that this connection reads and writes (docs/explanation/thread.md)"
CONFIRMING = "fieldtwin/confirm"
"""A topic to which no session subscribes; see `MqttSession.confirm`."""


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


def broker_at(url: BrokerUrl) -> Broker:
    """Return the broker of a URL, with the password from the environment.

    Raises `UsageError` for an unusable password file, and `Unreachable` for unusable certificate files.
    """
    tls = None
    if url.tls:
        tls = client_context(Endpoint.parse(f"tls://{url.address}?{urlencode(url.files)}"))
    return Broker(url.host, url.port, url.user, _password(), tls)


def _password() -> str | None:
    """Return the broker's password from the environment, or from the file that the environment names."""
    path = os.environ.get(f"{PASSWORD}_FILE")
    if not path:
        return os.environ.get(PASSWORD)
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()[0].strip()
    except (OSError, UnicodeDecodeError, IndexError) as e:
        why = getattr(e, "strerror", None) or "the file is empty"
        raise UsageError(f"the broker's password: {why}", got=f"{PASSWORD}_FILE={path}") from e


class MqttSession:
    """A connection to a broker. Every method but `aclose` raises `ConnectionLost` when the connection is lost."""

    def __init__(self, client: aiomqtt.Client, where: str, will: MqttMessage) -> None:
        self._client = client
        self._where = where
        self._will = will
        self._messages: AsyncIterator[aiomqtt.Message] = aiter(client.messages)

    async def subscribe(self, topic: str) -> None:
        """Subscribe with QoS 1. Raises `Unwelcome` if the broker denies it."""
        granted = await self._done(self._client.subscribe(topic, qos=1))
        if any(getattr(code, "value", code) >= FAILURE for code in granted):
            raise Unwelcome(f"the broker denies the subscription to {topic}", where=self._where, hint=ACCESS)

    async def publish(self, message: MqttMessage) -> None:
        """Publish a message. With QoS 1 and 2, wait for the broker's acknowledgement."""
        await self._done(self._client.publish(message.topic, message.payload, qos=message.qos, retain=message.retain))

    async def confirm(self) -> None:
        """Wait until the broker has received everything that was published before.

        A broker acknowledges no message of QoS 0, but it handles the packets of a client in their order. It must answer an
        UNSUBSCRIBE even if no subscription matches (MQTT 3.10.4), so its answer shows that the earlier packets arrived.
        """
        await self._done(self._client.unsubscribe(CONFIRMING))

    async def _done(self, call: Coroutine[Any, Any, R]) -> R:
        """Return the result of a call of the client.

        The client uses `asyncio.wait_for`, which before Python 3.12 loses a cancellation that comes together with the result.
        The task would run on, so this method raises the cancellation.
        """
        task = asyncio.current_task()
        cancelled_before = task.cancelling() if task is not None else 0
        try:
            result = await call
        except aiomqtt.MqttError as e:
            raise self._lost(e) from e
        if task is not None and task.cancelling() > cancelled_before:
            raise asyncio.CancelledError
        return result

    async def receive(self) -> tuple[str, bytes, bool]:
        """Return topic and payload of the next message, and whether the broker had retained it."""
        try:
            message = await anext(self._messages)
        except (aiomqtt.MqttError, StopAsyncIteration) as e:
            raise self._lost(e) from e
        payload = message.payload
        return message.topic.value, payload if isinstance(payload, bytes) else b"", message.retain

    def _lost(self, e: BaseException) -> ConnectionLost:
        return ConnectionLost(f"the broker is gone: {e}", where=self._where)

    async def aclose(self) -> None:
        """Publish the will, because the broker does not publish it for a client that disconnects, and disconnect."""
        with suppress(ConnectionLost, TimeoutError):
            async with asyncio.timeout(GOODBYE_S):
                await self.publish(self._will)
        with suppress(aiomqtt.MqttError):
            await self._client.__aexit__(None, None, None)


async def open_session(broker: Broker, will: MqttMessage) -> MqttSession:
    """Connect to a broker, which publishes `will` if the connection is lost.

    Raises `Unwelcome` if the broker refuses this client, and `Unreachable` if a later attempt may succeed.
    """
    if broker.tls is not None:
        broker.tls.sslsocket_class = _Socket
    heard = _LastMessage()
    logger = logging.Logger("mqtt", logging.WARNING)  # logger of this session only; nothing is printed
    logger.addHandler(heard)
    client = aiomqtt.Client(
        broker.host,
        broker.port,
        username=broker.username,
        password=broker.password,
        tls_context=broker.tls,
        timeout=TIMEOUT_S,
        keepalive=KEEPALIVE_S,
        max_queued_incoming_messages=QUEUED,
        logger=logger,
        will=aiomqtt.Will(will.topic, will.payload, will.qos, will.retain),
    )
    try:
        await client.__aenter__()
    except aiomqtt.MqttError as e:
        raise _refusal(e, heard.last, str(broker)) from e
    return MqttSession(client, str(broker), will)
