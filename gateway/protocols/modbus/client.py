"""The Modbus client. It has one connection, carries out one exchange at a time, and sends each request once.

It moves bytes between a `ByteConnection` and a `Transaction`, keeps the silences that a serial line requires, and counts results.
It never retries, reconnects or scales values: the runtime and the drivers do that. The caller opens the connection.
"""

from __future__ import annotations

from collections.abc import Coroutine, Sequence
from typing import Any, Self, TypeVar

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.fair_lock import FairLock
from fieldtwin.gateway.core.connection import ByteConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import (
    ConnectionLost,
    CrcError,
    Desync,
    FieldtwinError,
    ModbusExceptionReply,
    ReplyTimeout,
    UsageError,
    VerifyFailed,
)
from fieldtwin.gateway.core.histogram import response_times
from fieldtwin.gateway.protocols.modbus.client_counters import ClientCounters
from fieldtwin.gateway.protocols.modbus.frames.selection import Framing, framing_of, make_framer
from fieldtwin.gateway.protocols.modbus.line import TURNAROUND_S, LineSilence
from fieldtwin.gateway.protocols.modbus.requests.data import (
    BitTable,
    MaskWriteRegister,
    ReadBits,
    ReadRegisters,
    ReadWriteRegisters,
    RegisterTable,
    WriteCoil,
    WriteCoils,
    WriteRegister,
    WriteRegisters,
)
from fieldtwin.gateway.protocols.modbus.requests.identity import ReadDeviceIdentification
from fieldtwin.gateway.protocols.modbus.requests.refusals import GatewayRefusal
from fieldtwin.gateway.protocols.modbus.requests.replies import BitsReply, RegistersReply, Reply, WriteReply
from fieldtwin.gateway.protocols.modbus.requests.request import Request
from fieldtwin.gateway.protocols.modbus.transaction import Transaction
from fieldtwin.gateway.protocols.modbus.unit_timing import UnitTiming, checked_pause, checked_timeout

R = TypeVar("R", bound=Reply)


class ModbusClient:
    """A Modbus client on `connection`, which the client owns, and closes in `aclose`.

    `serial` gives the character time of a serial line. It is used for silences, and for deadlines that exclude the time of
    transmission. Without it (RTU inside TCP) frames need no silence. `timeout_s` is the time in which a unit has to answer,
    `turnaround_s` the time that all units get to execute a broadcast, `spacing_s` a pause after every exchange, and `silence_s`
    the silence before a request if it differs from that of SL 2.5.1.1. `echo` and `strict` are described in `RtuFramer`,
    `accepts_zero_id` in `MbapFramer`. The constructor raises `UsageError` for a setting that the framing does not have.
    """

    def __init__(
        self,
        connection: ByteConnection,
        clock: Clock,
        *,
        framing: Framing,
        serial: SerialSettings | None = None,
        timeout_s: float = 1.0,
        echo: bool = False,
        strict: bool = False,
        accepts_zero_id: bool = False,
        turnaround_s: float = TURNAROUND_S,
        spacing_s: float = 0.0,
        silence_s: float | None = None,
    ) -> None:
        self._connection = connection
        self._clock = clock
        self._char_time_ns = round(serial.char_time_s * NS_PER_S) if serial is not None else 0
        self._framer = make_framer(
            framing,
            char_time_ns=self._char_time_ns,
            echo=echo,
            strict=strict,
            accepts_zero_id=accepts_zero_id,
        )
        self._line = LineSilence(
            t35_ns=self._framer.t35_ns if silence_s is None else round(checked_pause(silence_s) * NS_PER_S),
            settle_ns=self._framer.rest_ns,
            quarantines=not self._framer.confirms_transmission,
            turnaround_ns=round(checked_timeout(turnaround_s) * NS_PER_S),
            spacing_ns=round(checked_pause(spacing_s) * NS_PER_S),
        )
        self.units = UnitTiming(timeout_s, has_broadcast=self._framer.has_broadcast)
        self._turn = FairLock()
        self._closed = False
        self.counters = ClientCounters()
        self.latency = (
            response_times()
        )  # response times of replies and exceptions; a caller that counts across connections sets its own histogram

    @classmethod
    def at(
        cls,
        endpoint: Endpoint,
        connection: ByteConnection,
        clock: Clock,
        *,
        timeout_s: float = 1.0,
        echo: bool = False,
        strict: bool = False,
        accepts_zero_id: bool = False,
        turnaround_s: float = TURNAROUND_S,
        spacing_s: float = 0.0,
    ) -> Self:
        """Return a client with the framing and the character time of `endpoint`, for which `connection` was opened."""
        return cls(
            connection,
            clock,
            framing=framing_of(endpoint),
            serial=endpoint.serial if endpoint.is_serial else None,
            timeout_s=timeout_s,
            echo=echo,
            strict=strict,
            accepts_zero_id=accepts_zero_id,
            turnaround_s=turnaround_s,
            spacing_s=spacing_s,
            silence_s=endpoint.silence_s if endpoint.is_serial else None,
        )

    def restate(self, *, timeout_s: float, turnaround_s: float, spacing_s: float) -> None:
        """Change the timing of the whole connection from the next request on; parameters as in the constructor."""
        self.units.restate(timeout_s)
        self._line.restate(
            turnaround_ns=round(checked_timeout(turnaround_s) * NS_PER_S),
            spacing_ns=round(checked_pause(spacing_s) * NS_PER_S),
        )

    @property
    def clear_ns(self) -> int:
        """Return the time (ns) when the line can be used again if nothing arrives: now, or later if the last exchange failed."""
        return self._line.clear_ns(self._clock.monotonic_ns())

    @property
    def closed(self) -> bool:
        """Return whether the client can send no more requests, because it was closed or the connection was lost."""
        return self._closed or self._connection.lost is not None

    async def aclose(self) -> None:
        """Close the connection; an exchange in progress ends with `ConnectionLost`. Closing twice does nothing."""
        self._closed = True
        await self._connection.aclose()

    # -- requests ------------------------------------------------------------------------------------------------

    def read_registers(
        self, unit: int, table: RegisterTable, address: int, count: int, timeout_s: float | None = None
    ) -> Coroutine[Any, Any, RegistersReply]:
        """Read 1 to 125 holding (03h) or input (04h) registers. Errors as `execute`."""
        return self.execute(unit, ReadRegisters(table, address, count), timeout_s)

    def read_bits(
        self, unit: int, table: BitTable, address: int, count: int, timeout_s: float | None = None
    ) -> Coroutine[Any, Any, BitsReply]:
        """Read 1 to 2000 coils (01h) or discrete inputs (02h). Errors as `execute`."""
        return self.execute(unit, ReadBits(table, address, count), timeout_s)

    async def write_register(self, unit: int, address: int, value: int, timeout_s: float | None = None) -> WriteReply:
        """Write one holding register (06h). Errors as `execute`."""
        return await self.execute(unit, WriteRegister(address, value), timeout_s)

    async def write_registers(
        self, unit: int, address: int, values: Sequence[int], timeout_s: float | None = None
    ) -> WriteReply:
        """Write 1 to 123 holding registers in one request (10h). Errors as `execute`."""
        return await self.execute(unit, WriteRegisters(address, tuple(values)), timeout_s)

    async def write_coil(self, unit: int, address: int, value: bool, timeout_s: float | None = None) -> WriteReply:
        """Write one coil (05h). Errors as `execute`."""
        return await self.execute(unit, WriteCoil(address, value), timeout_s)

    async def write_coils(
        self, unit: int, address: int, values: Sequence[bool], timeout_s: float | None = None
    ) -> WriteReply:
        """Write 1 to 1968 coils in one request (0Fh). Errors as `execute`."""
        return await self.execute(unit, WriteCoils(address, tuple(values)), timeout_s)

    async def mask_write(
        self, unit: int, address: int, and_mask: int, or_mask: int, timeout_s: float | None = None
    ) -> WriteReply:
        """Change single bits of a holding register inside the device (16h). Errors as `execute`."""
        return await self.execute(unit, MaskWriteRegister(address, and_mask, or_mask), timeout_s)

    async def read_write_registers(
        self,
        unit: int,
        read_address: int,
        read_count: int,
        write_address: int,
        values: Sequence[int],
        timeout_s: float | None = None,
    ) -> RegistersReply:
        """Write, then read holding registers in one request (17h). Errors as `execute`."""
        request = ReadWriteRegisters(read_address, read_count, write_address, tuple(values))
        return await self.execute(unit, request, timeout_s)

    async def read_identification(
        self, unit: int, read_code: int = 1, timeout_s: float | None = None
    ) -> dict[int, bytes]:
        """Return all objects of a category (1 basic, 2 regular, 3 extended) by their ID.

        It carries out as many exchanges of 2Bh/0Eh as needed; it always ends, because the IDs have to increase. Errors as
        `execute`.
        """
        objects: dict[int, bytes] = {}
        request = ReadDeviceIdentification(read_code)
        while True:
            reply = await self.execute(unit, request, timeout_s)
            objects.update(reply.objects)
            if not reply.more_follows:
                return objects
            request = ReadDeviceIdentification(read_code, reply.next_object_id)

    async def execute(self, unit: int, request: Request[R], timeout_s: float | None = None) -> R:
        """Send `request` once and return its reply, after waiting for other requests and for silence on the line.

        `timeout_s` counts from the end of transmission; the reply's own transmission time is added. Raises
        `ReplyTimeout`, `CrcError`, `Desync`, `ModbusExceptionReply` or `VerifyFailed`; `UsageError` before anything is
        sent; `ConnectionLost` when the client can no longer be used. Cancelling is safe: the reply is never taken for
        the reply to a different request.
        """
        units = self.units
        timeout_ns = units.timeout_ns(unit) if timeout_s is None else round(checked_timeout(timeout_s) * NS_PER_S)
        if not 0 <= unit <= 255:
            raise UsageError("unit id out of range", expected="0 to 255", got=str(unit))
        if units.shortened_ns and (shortened_ns := units.shortened_ns.get(unit)) is not None:
            timeout_ns = min(timeout_ns, shortened_ns)
        unanswered = not request.expects_reply or (unit == 0 and self._framer.has_broadcast)
        if unanswered:
            request.unanswered(0)  # refuses a request that cannot be broadcast
        if not self._turn.take():
            await self._turn.wait()
        try:
            if self._closed:
                raise closed_locally(self._connection.endpoint)
            if units.spaced or units.held:
                await self._await_spacing(unit)
                units.held.pop(unit, None)
            if not self._is_silent():
                await self._await_silence()
            transaction = Transaction(
                self._framer, unit, request, timeout_ns=timeout_ns, char_time_ns=self._char_time_ns
            )
            try:
                if unanswered:
                    return await self._send_only(transaction, request)
                return await self._exchange(unit, transaction, timeout_ns)
            finally:
                if units.have_pauses:
                    units.used(unit, self._clock.monotonic_ns())
        finally:
            self._turn.pass_on()

    # -- one exchange --------------------------------------------------------------------------------------------

    async def _exchange(self, unit: int, transaction: Transaction[R], timeout_ns: int) -> R:
        before = (self._framer.late_bytes, self._framer.noise_bytes, self._framer.foreign_frames)
        counters, line = self.counters, self._line
        counters.requests += 1
        settled = False
        try:
            reply = await self._send_and_await(transaction)
            counters.replies += 1
            settled = True
            line.answered(reply.t_ns, transaction.sent_ns)
            self.latency.record(reply.t_ns - transaction.sent_ns)
            if self.units.shortened_ns:
                self.units.restore_timeout(unit)
            return reply
        except ModbusExceptionReply as e:
            counters.exceptions += 1
            settled = True
            now_ns = self._clock.monotonic_ns()
            line.answered(now_ns, transaction.sent_ns)
            self.latency.record(now_ns - transaction.sent_ns)
            if not isinstance(e, GatewayRefusal):
                self.units.restore_timeout(unit)
            self._place(e)
            raise
        except CrcError as e:
            counters.crc_errors += 1
            # An error before the deadline means that our reply was complete but damaged; at the deadline it means noise.
            settled = self._clock.monotonic_ns() < transaction.deadline_ns
            line.damaged(self._clock.monotonic_ns())
            self._place(e)
            raise
        except (Desync, ReplyTimeout, VerifyFailed) as e:
            self._count(e)
            if self.units.is_shortened(unit) and isinstance(e, ReplyTimeout):
                now_ns = self._clock.monotonic_ns()
                self.units.pass_over(unit, transaction.sent_ns, now_ns, timeout_ns, self._line.longest_latency_ns)
                self._line.passed_over(now_ns)
                settled = True
            self._place(e)
            raise
        except BaseException:
            counters.abandoned += 1
            raise
        finally:
            if not settled:
                line.given_up(self._clock.monotonic_ns(), transaction.sent_ns, timeout_ns)
            late, noise, foreign = before
            counters.late_bytes += self._framer.late_bytes - late
            counters.noise_bytes += self._framer.noise_bytes - noise
            counters.foreign_frames += self._framer.foreign_frames - foreign
            if self._framer.strays:
                self.units.note_strays(self._framer.strays, self._clock.monotonic_ns())

    async def _send_and_await(self, transaction: Transaction[R]) -> R:
        clock, connection = self._clock, self._connection
        await connection.write(transaction.start(clock.monotonic_ns()))
        transaction.handed_over(clock.monotonic_ns())
        arrived = connection.inbound.data_stream
        while True:
            data = await (self._read_pending() if arrived else self._read_until(transaction.wake_ns))
            now_ns = clock.monotonic_ns()
            reply = transaction.feed(data, now_ns) if data else None
            if reply is None and (not data or now_ns >= transaction.deadline_ns):  # noise does not prolong the wait
                reply = transaction.poll(now_ns)
            if reply is not None:
                return reply

    async def _send_only(self, transaction: Transaction[R], request: Request[R]) -> R:
        self.counters.requests += 1
        try:
            await self._connection.write(transaction.start(self._clock.monotonic_ns()))
        except BaseException:
            self.counters.abandoned += 1
            raise
        finally:
            transaction.handed_over(self._clock.monotonic_ns())
            self._line.broadcast(transaction.sent_ns)
        self.counters.broadcasts += 1
        return request.unanswered(transaction.sent_ns)

    # -- silence between exchanges -------------------------------------------------------------------------------

    def _is_silent(self) -> bool:
        """Return whether a request may be sent immediately, which is the usual case.

        If not, the caller calls `_await_silence`.
        """
        connection = self._connection
        if connection.inbound.data_stream or connection.lost is not None:
            return False
        return self._line.may_go(self._clock.monotonic_ns())

    async def _await_spacing(self, unit: int) -> None:
        """Wait until `unit` needs no more pause. Bytes that arrive meanwhile belong to no request; they are counted and
        discarded.
        """
        while (until_ns := self.units.spaced_ns(unit)) > self._clock.monotonic_ns() and self._connection.lost is None:
            data = await self._read_until(until_ns)
            self._drain(data, self._clock.monotonic_ns(), live=True)

    async def _await_silence(self) -> None:
        """Wait until a request may be sent. Bytes that arrive before belong to no request; they are counted and discarded.

        Raises `Desync` if the line does not become silent, `ConnectionLost` if the connection was lost.
        """
        now_ns = self._clock.monotonic_ns()
        babble_ns = self._line.babble_ns(now_ns)
        self._drain(self._connection.read_pending(), now_ns, live=False)
        while (clear_ns := self._line.clear_ns(now_ns)) > now_ns:
            data = await self._read_until(clear_ns)
            now_ns = self._clock.monotonic_ns()
            self._drain(data, now_ns, live=True)
            if data and now_ns >= babble_ns:
                self._line.babbled()
                where = str(self._connection.endpoint)
                raise Desync(
                    "the line is never silent",
                    where=where,
                    hint="another client on the line, or a unit that sends continuously",
                )
        lost = self._connection.lost
        if lost is not None:
            raise ConnectionLost(lost.message, where=lost.where)
        self._line.may_go(now_ns)

    def _drain(self, data: bytes, now_ns: int, *, live: bool) -> None:
        if data:
            before = self._framer.late_bytes, self._framer.noise_bytes
            self._framer.drained(data)
            self.counters.late_bytes += self._framer.late_bytes - before[0]
            self.counters.noise_bytes += self._framer.noise_bytes - before[1]
            self._line.heard(now_ns, live=live)
            if self._framer.strays:
                self.units.note_strays(self._framer.strays, self._clock.monotonic_ns())

    def _read_until(self, deadline_ns: int) -> Coroutine[Any, Any, bytes]:
        """Return the bytes that arrive next, or b"" if none arrive before `deadline_ns`."""
        left_s = (deadline_ns - self._clock.monotonic_ns()) / NS_PER_S
        return self._connection.read_within(left_s if left_s > 0.0 else 0.0)

    async def _read_pending(self) -> bytes:
        """Return the bytes that have already arrived, possibly none.

        If the link carries datagrams, only the first one is returned, so that two are never joined.
        """
        connection = self._connection
        if not self._framer.datagrams:
            return connection.read_pending()
        return await connection.read() if connection.inbound.data_stream else b""

    # -- helpers -------------------------------------------------------------------------------------------------

    def _count(self, error: FieldtwinError) -> None:
        if isinstance(error, Desync):
            self.counters.desyncs += 1
        elif isinstance(error, ReplyTimeout):
            self.counters.timeouts += 1
        else:
            self.counters.verify_failures += 1

    def _place(self, error: FieldtwinError) -> None:
        error.at(str(self._connection.endpoint))
