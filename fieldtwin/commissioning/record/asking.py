"""Send one arbitrary request PDU to a live device and return the result as a `RecordedExchange`.

The gateway's own Modbus client sends the request, with the silent intervals and the validation of replies of normal
operation. It never retries; a fault of the connection is a possible outcome. This module must never decide which requests are
allowed: the caller does, with `changes`.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fieldtwin.commissioning.access.connection import frame_of, modbus_at
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Connector, Direction, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import (
    ConnectionLost,
    CrcError,
    Desync,
    ModbusExceptionReply,
    ReplyTimeout,
    VerifyFailed,
)
from fieldtwin.gateway.core.files.recording import ExchangeError, RecordedExchange
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of
from fieldtwin.gateway.protocols.modbus.server.analysis import BROADCAST_FUNCTIONS, ServerRequest, examine
from fieldtwin.gateway.protocols.modbus.server.forward import Forwarded
from fieldtwin.gateway.wallclock import WallClock

_READS = frozenset({1, 2, 3, 4})


def asked_of(pdu: bytes) -> ServerRequest | None:
    """Parse a request, even a malformed read (which a device refuses); None for a PDU that cannot be a request."""
    try:
        return examine(pdu)
    except ModbusExceptionReply:
        return ServerRequest(pdu[0], changes=pdu[0] not in _READS) if pdu and 1 <= pdu[0] <= 0x7F else None


def changes(pdu: bytes) -> bool:
    """Return whether a request may change the device. Functions outside the standard count as changes."""
    asked = asked_of(pdu)
    return asked is None or asked.changes


def frame_for(url: str, unit: int, pdu: bytes) -> bytes | None:
    """Return the frame of a request on the endpoint `url`, for `--dry-run`; None for a PDU that cannot be sent."""
    asked = asked_of(pdu)
    if asked is None:
        return None
    return frame_of(url, unit, Forwarded(unit, pdu, asked, on_line=framing_of(Endpoint.parse(url)) == "rtu"))


class _Sent(Tap):
    """An observer of a connection that records the time of the last byte of the latest sent frame."""

    def __init__(self, char_time_ns: int) -> None:
        self.t_ns = 0
        self._char_time_ns = char_time_ns

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None:
        if direction is Direction.SENT:
            self.t_ns = t_ns + len(data) * self._char_time_ns

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        """Ignore CAN frames: a Modbus connection has none."""


class RecordingClient:
    """A sender of single requests through `client`, which returns recorded exchanges. Their times are relative to `zero_ns`
    of `clock`.
    """

    def __init__(self, client: ModbusClient, clock: Clock, endpoint: Endpoint, sent: _Sent, zero_ns: int) -> None:
        self.client = client
        self.asked = 0
        self._clock = clock
        self._on_line = framing_of(endpoint) == "rtu"
        self._broadcasts = endpoint.is_serial or endpoint.scheme == "rtu+tcp"
        self._sent = sent
        self._zero_ns = zero_ns
        self._lost = False

    async def ask(self, unit: int, pdu: bytes) -> RecordedExchange | None:
        """Send the request and return the exchange; None if the request cannot be sent.

        Raises `ConnectionLost` if the connection was already lost. If it is lost during the request, the exchange has the error
        ``lost``.
        """
        asked = asked_of(pdu)
        if asked is None or (unit == 0 and self._broadcasts and pdu[0] not in BROADCAST_FUNCTIONS):
            return None
        self._sent.t_ns = began_ns = self._clock.monotonic_ns()
        reply: bytes | None = None
        error: ExchangeError | None = None
        end_ns = 0
        self.asked += 1
        try:
            answer = await self.client.execute(unit, Forwarded(unit, pdu, asked, on_line=self._on_line))
            reply, end_ns = answer.raw, answer.t_ns
        except ModbusExceptionReply as e:
            reply, end_ns = bytes((pdu[0] | 0x80, e.code)), self._clock.monotonic_ns()
        except ReplyTimeout:
            error = "timeout"
        except CrcError:
            error = "crc"
        except (Desync, VerifyFailed):
            error = "desync"
        except ConnectionLost:
            if self._lost:
                raise
            self._lost, error = True, "lost"
        sent_ns = self._sent.t_ns
        latency_s = max(end_ns - sent_ns, 0) / NS_PER_S if reply else 0.0
        t_s = max(min(began_ns, sent_ns) - self._zero_ns, 0) / NS_PER_S
        return RecordedExchange(round(t_s, 6), unit, pdu, reply, round(latency_s, 6), error)


@asynccontextmanager
async def asker_at(
    url: str,
    *,
    timeout_s: float = 1.0,
    spacing_s: float = 0.0,
    echo: bool = False,
    zero_ns: int | None = None,
    taps: tuple[Tap, ...] = (),
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> AsyncIterator[RecordingClient]:
    """Yield a `RecordingClient` on the endpoint `url`. Raises the same errors as `modbus_at`.

    The times of exchanges are relative to `zero_ns` (None: the time at which the connection is open).
    """
    clock = clock or WallClock()
    endpoint = Endpoint.parse(url)
    sent = _Sent(round(endpoint.serial.char_time_s * NS_PER_S) if endpoint.is_serial else 0)
    async with modbus_at(
        url, timeout_s=timeout_s, spacing_s=spacing_s, echo=echo, taps=(sent, *taps), connector=connector, clock=clock
    ) as client:
        yield RecordingClient(client, clock, endpoint, sent, clock.monotonic_ns() if zero_ns is None else zero_ns)
