"""Send one question to a device and classify the result.

A question is a read of a range or an object, or a request with a function code; it is repeated as often as a sweep needs. A
busy reply is not a refusal, and noise may be the cause of silence. This module must never send a request that changes the
device.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, Protocol

from fieldtwin.commissioning.dump.objects import ObjectKey
from fieldtwin.commissioning.dump.sweep import Invalid, Outcome, RefusedRead, Silent, Taken
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import (
    Bug,
    CrcError,
    Desync,
    ModbusExceptionReply,
    ReplyTimeout,
    SdoAborted,
    WireError,
    WrongSize,
)
from fieldtwin.gateway.core.files.profile import RegisterRange
from fieldtwin.gateway.devices.read_plan import cells, read_request
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import TIMED_OUT
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.requests.diagnostics import Diagnostics, GetCommEventCounter, GetCommEventLog
from fieldtwin.gateway.protocols.modbus.requests.identity import (
    ReadDeviceIdentification,
    ReadExceptionStatus,
    ReportServerId,
)
from fieldtwin.gateway.protocols.modbus.requests.request import Request

ACKNOWLEDGE, BUSY, NO_PATH, NO_TARGET = 0x05, 0x06, 0x0A, 0x0B
BUSY_WAIT_S = 0.2
MOST_BUSY = 10
LOOPBACK_WORD = 0xA537

PROBES: tuple[tuple[int, Request[Any]], ...] = (
    (0x07, ReadExceptionStatus()),
    (0x08, Diagnostics(0, LOOPBACK_WORD)),
    (0x0B, GetCommEventCounter()),
    (0x0C, GetCommEventLog()),
    (0x11, ReportServerId()),
    (0x2B, ReadDeviceIdentification(1)),
)
"""Requests with functions that only read. Whether a device has other functions cannot be tested without side effects."""


@dataclass(frozen=True, slots=True)
class AskResult:
    """The result of one question to a device.

    `us` is the time in microseconds from the question to the last byte of the answer, `requests` the number of requests
    sent.
    """

    outcome: Outcome
    us: int
    requests: int


class DeviceReader(Protocol):
    """The interface through which a dump reads one device, of either protocol."""

    async def read(self, asked: RegisterRange | ObjectKey, *, patient: bool = True) -> AskResult:
        """Read a range or an object, without any retry unless `patient`. Raises only errors that end the connection."""
        ...

    async def function(self, request: Request[Any]) -> AskResult:
        """Send `request`, which tests whether the device has its function, and return the result."""
        ...


class ModbusAsker:
    """A reader that sends its questions to one unit through `client`.

    A request without a good reply is repeated up to `retries` times; after each exchange the line is left free for
    `spacing_s` seconds.
    """

    def __init__(
        self, client: ModbusClient, unit: int, clock: Clock, *, retries: int = 2, spacing_s: float = 0.0
    ) -> None:
        self._client, self._unit, self._clock = client, unit, clock
        self._retries, self._spacing_ns = retries, round(spacing_s * NS_PER_S)
        self._free_ns = 0

    async def read(self, asked: RegisterRange | ObjectKey, *, patient: bool = True) -> AskResult:
        if not isinstance(asked, RegisterRange):
            raise Bug("a unit has registers", got=str(asked))
        return await self._patiently(lambda: self._read(asked), self._retries if patient else 0)

    async def function(self, request: Request[Any]) -> AskResult:
        async def once() -> tuple[bytes, int]:
            reply = await self._client.execute(self._unit, request)
            return reply.raw, reply.t_ns

        return await self._patiently(once, self._retries)

    async def _read(self, at: RegisterRange) -> tuple[bytes, int]:
        reply = await self._client.execute(self._unit, read_request(at))
        return cells(reply), reply.t_ns

    async def _patiently(self, once: Callable[[], Awaitable[tuple[bytes, int]]], retries: int) -> AskResult:
        lost = busy = 0
        invalid: WireError | None = None
        first_ns = self._clock.monotonic_ns()
        while True:
            await self._clock.sleep_until_ns(self._free_ns)
            asked_ns = self._clock.monotonic_ns()
            try:
                raw, t_ns = await once()
            except ModbusExceptionReply as e:
                if e.code in (NO_PATH, NO_TARGET):
                    raise  # the exception is that of a gateway, not of the device
                if e.code not in (ACKNOWLEDGE, BUSY) or busy >= MOST_BUSY:
                    return AskResult(RefusedRead(e.code), self._us(asked_ns), lost + busy + 1)
                busy += 1
                await self._clock.sleep_until_ns(self._clock.monotonic_ns() + round(BUSY_WAIT_S * NS_PER_S))
            except (ReplyTimeout, CrcError, Desync) as e:
                lost += 1
                if not isinstance(e, ReplyTimeout):
                    invalid = e
                if lost > retries:
                    return AskResult(_without_result(invalid or e), self._us(first_ns), lost + busy)
            else:
                return AskResult(Taken(raw), max(0, t_ns - asked_ns) // 1000, lost + busy + 1)
            finally:
                self._free_ns = self._clock.monotonic_ns() + self._spacing_ns

    def _us(self, since_ns: int) -> int:
        return (self._clock.monotonic_ns() - since_ns) // 1000


def _without_result(error: WireError) -> Silent | Invalid:
    """Classify a failed exchange: silence and an invalid reply are different findings about a device."""
    if isinstance(error, ReplyTimeout):
        return Silent(error.message)
    return Invalid(error.message, values=error.got_bytes // 2 if isinstance(error, WrongSize) else 0)


class CanopenAsker:
    """A reader that asks one node through `master`. A pause of `spacing_s` after each transfer leaves the bus free for others."""

    def __init__(
        self, master: CanopenMaster, node: int, clock: Clock, *, retries: int = 2, spacing_s: float = 0.0
    ) -> None:
        self._master, self._node, self._clock = master, node, clock
        self._retries, self._spacing_ns = retries, round(spacing_s * NS_PER_S)

    async def read(self, asked: RegisterRange | ObjectKey, *, patient: bool = True) -> AskResult:
        if not isinstance(asked, ObjectKey):
            raise Bug("a node has objects", got=str(asked))
        lost = 0
        while True:
            asked_ns = self._clock.monotonic_ns()
            try:
                outcome: Outcome = Taken(await self._master.sdo_upload(self._node, asked.index, asked.subindex))
            except SdoAborted as e:
                if e.code != TIMED_OUT:
                    outcome = RefusedRead(e.code)
                else:
                    outcome = Silent(e.message)
            except (ReplyTimeout, CrcError, Desync) as e:
                outcome = _without_result(e)
            now_ns = self._clock.monotonic_ns()
            failed = isinstance(outcome, Silent | Invalid)
            lost += failed
            if self._spacing_ns:
                await self._clock.sleep_until_ns(now_ns + self._spacing_ns)
            if not failed or lost > (self._retries if patient else 0):
                return AskResult(outcome, (now_ns - asked_ns) // 1000, lost + (not failed))

    async def function(self, request: Request[Any]) -> AskResult:
        raise Bug("a node has no functions", got=str(request))
