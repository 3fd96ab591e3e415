"""One Modbus unit: it takes request PDUs and returns response PDUs (MODBUS Application Protocol V1.1b3, AP below).

This module performs no I/O and does not depend on unit IDs, checksums, transaction IDs or the transport. The bank defines the
meaning of the registers. Each function has its own module; this module selects the function, refuses invalid requests, and
counts and logs all requests.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypedDict

from fieldtwin.emulators.modbus.bank import DeviceIsBusy, IllegalFunction, NegativeAcknowledge, Refusal, RegisterBank
from fieldtwin.emulators.modbus.functions.diagnostics import UnitCounters, UnitDiagnostics
from fieldtwin.emulators.modbus.functions.event_log import MAX_EVENTS
from fieldtwin.emulators.modbus.functions.fifo import FifoQueues
from fieldtwin.emulators.modbus.functions.file_records import FileRecords
from fieldtwin.emulators.modbus.functions.identification import Identification
from fieldtwin.emulators.modbus.functions.registers import (
    STANDARD_FUNCTIONS,
    TABLES,
    RegisterFunctions,
    UnitLimits,
    require_length,
)
from fieldtwin.gateway.core.errors import UsageError

__all__ = ["ALL_FUNCTIONS", "Handler", "ModbusUnit", "UnitLimits", "UnitParts"]

ALL_FUNCTIONS = STANDARD_FUNCTIONS
BROADCAST_FUNCTIONS = frozenset({0x05, 0x06, 0x0F, 0x10, 0x15, 0x16})
"""Functions that are accepted as a broadcast: writes that do not ask for data (SL 2.4.1)."""
WHILE_BUSY = frozenset({0x08, 0x0B, 0x0C})
"""Functions that a busy unit still answers, so that a client can find out that it is busy (AP 6.9)."""

MAX_SERVER_DATA = 249
"""The number of bytes of the server ID, and of the data after the run indicator, that fit a reply to 11h together."""

Handler = Callable[[bytes, int], bytes | None]
"""A function that is called with the request PDU and now_ns, and returns the response PDU, or None if no response is sent. It may
raise a `Refusal` if it has changed nothing.
"""


class UnitParts(TypedDict, total=False):
    """The optional parts of a unit in addition to its registers, as keyword arguments of `ModbusUnit`."""

    server_id: bytes | None
    server_data: bytes
    identification: Identification | None
    files: FileRecords | None
    fifos: FifoQueues | None


class ModbusUnit:
    """The functions of a unit on a bank.

    Without `server_id` (function 11h; `server_data` follows its run indicator), `identification` (2Bh), `files` (14h,
    15h) or `fifos` (18h) the unit lacks that function. Without `limits` it has all other functions.

    Use `respond` for a request to the unit, and `execute_broadcast` for a request to unit 0 of a serial line. Both increase
    `counters`; the server of the line reports the traffic of other units with `heard`. `latency_s` is the processing time of the
    last answer. `running` is the run indicator of 11h.
    """

    def __init__(
        self,
        bank: RegisterBank,
        limits: UnitLimits | None = None,
        server_id: bytes | None = None,
        name: str = "",
        *,
        server_data: bytes = b"",
        identification: Identification | None = None,
        files: FileRecords | None = None,
        fifos: FifoQueues | None = None,
    ) -> None:
        if len((server_id or b"") + server_data) > MAX_SERVER_DATA:
            got = str(len((server_id or b"") + server_data))
            raise UsageError("server id and the data after it", expected=f"at most {MAX_SERVER_DATA} bytes", got=got)
        self.bank = bank
        self.limits = limits or UnitLimits()
        self.name = name
        self.counters = UnitCounters()
        self.diagnostics = UnitDiagnostics(self.counters)
        self.files = files
        self.fifos = fifos
        self.latency_s = 0.0
        self.running = True
        self.request_lengths: dict[int, int] = {}
        """Lengths in bytes of the request PDUs of device-specific functions, by function code. A serial line uses them to find
        the end of a request; without a length it uses the checksum.
        """
        self._server_id = server_id
        self._server_data = server_data
        self._busy_until_ns = 0
        self._busy_every = self._busy_for_ns = self._answered = 0
        self._broadcasts = set(BROADCAST_FUNCTIONS)
        self._handlers = {f: h for f, h in self._standard(identification).items() if f in self.limits.functions}

    def _standard(self, identification: Identification | None) -> dict[int, Handler]:
        cells = RegisterFunctions(self.bank, self.limits)
        read: Handler = cells.read
        handlers: dict[int, Handler] = {
            **dict.fromkeys(TABLES, read),
            0x05: cells.write_coil,
            0x06: cells.write_register,
            0x07: lambda pdu, now_ns: self.diagnostics.exception_status(pdu),
            0x08: lambda pdu, now_ns: self.diagnostics.respond(pdu),
            0x0B: lambda pdu, now_ns: self.diagnostics.event_counter(pdu, now_ns < self._busy_until_ns),
            0x0C: lambda pdu, now_ns: self.diagnostics.event_log(pdu, now_ns < self._busy_until_ns),
            0x0F: cells.write_coils,
            0x10: cells.write_registers,
            0x16: cells.mask_write,
            0x17: cells.read_write,
        }
        if self._server_id is not None:
            handlers[0x11] = self._report_server_id
        if self.files is not None:
            handlers |= {0x14: self.files.respond_read, 0x15: self.files.respond_write}
        if self.fifos is not None:
            handlers[0x18] = self.fifos.respond
        if identification is not None:
            handlers[0x2B] = identification.respond
        return handlers

    def register(
        self, function: int, handler: Handler, *, broadcast: bool = False, request_length: int | None = None
    ) -> None:
        """Answer `function` (1 to 127) with `handler` from now on. It may replace a standard function.

        `broadcast`: the function is also executed when it is sent to unit 0 of a serial line. `request_length`: bytes
        of its request PDU, if their number is constant; the lengths of standard functions are known.
        """
        if not 1 <= function <= 0x7F:
            raise UsageError("function code", expected="1 to 127", got=str(function))
        self._handlers[function] = handler
        if broadcast:
            self._broadcasts.add(function)
        if request_length is not None:
            self.request_lengths[function] = request_length

    def be_busy(self, until_ns: int) -> None:
        """Answer with exception 06 until `until_ns` of the emulator's time; functions 08, 0B and 0C still work."""
        self._busy_until_ns = until_ns

    def be_busy_after(self, every: int, for_ns: int) -> None:
        """Be busy for `for_ns` nanoseconds after every `every` requests that were not refused as busy. If `every` is 0, never."""
        self._busy_every, self._busy_for_ns = every, for_ns

    def respond(self, pdu: bytes, now_ns: int) -> bytes | None:
        """Execute a request to this unit and return its response, exception responses included.

        Return None if there is no answer: in listen-only mode, to the request that starts or ends it, to an empty PDU, and to
        function codes from 80h on. By AP 4.1 those are exception responses, and answering an answer could continue endlessly.
        """
        return self._counted(pdu, now_ns, busy=False)

    def refuse_busy(self, pdu: bytes) -> bytes | None:
        """Answer exception 06 to a request above the limit of requests in progress; execute nothing."""
        return self._counted(pdu, 0, busy=True)

    def refuse_function(self, pdu: bytes) -> bytes | None:
        """Answer exception 01 to a request that the sender may not make; execute nothing."""
        self.counters.requests += 1
        if not pdu or pdu[0] >= 0x80 or self.diagnostics.listen_only:
            self.counters.unanswered += 1
            return None
        self.counters.exceptions += 1
        self.counters.replies += 1
        return bytes((pdu[0] | 0x80, IllegalFunction.code))

    def execute_broadcast(self, pdu: bytes, now_ns: int) -> None:
        """Execute a request to unit 0 without an answer; reads and refused writes have no effect."""
        self.counters.broadcasts += 1
        self.counters.unanswered += 1
        listening = self.diagnostics.listen_only
        self.diagnostics.log.note_received(listening=listening, broadcast=True)
        if listening or not pdu or pdu[0] not in self._broadcasts or now_ns < self._busy_until_ns:
            return
        handler = self._handlers.get(pdu[0])
        if handler is None:
            return
        try:
            handler(pdu, now_ns)
        except Refusal:
            return  # a broadcast is never answered, and a refused one changed nothing (SL 2.4.1)
        self.diagnostics.completed(pdu)

    def heard(self, messages: int = 0, errors: int = 0) -> None:
        """Count complete and damaged frames that the line carried, whatever their unit ID."""
        self.counters.bus_messages += messages
        self.counters.bus_errors += errors
        for _ in range(min(errors, MAX_EVENTS)) if errors else ():
            self.diagnostics.log.note_received(listening=self.diagnostics.listen_only, damaged=True)

    def _counted(self, pdu: bytes, now_ns: int, busy: bool) -> bytes | None:
        self.counters.requests += 1  # counted first, because a request for the counters or the log includes itself
        self.diagnostics.log.note_received(listening=self.diagnostics.listen_only)
        response = self._answer(pdu, now_ns, busy)
        if response is None:
            self.counters.unanswered += 1
        else:
            self.counters.replies += 1
            self.diagnostics.log.note_sent(response)
        return response

    def _answer(self, pdu: bytes, now_ns: int, busy: bool) -> bytes | None:
        if not pdu or pdu[0] >= 0x80:
            return None
        if self.diagnostics.listen_only:
            self.diagnostics.wakes(pdu)
            return None
        try:
            if busy or (now_ns < self._busy_until_ns and pdu[0] not in WHILE_BUSY):
                raise DeviceIsBusy("too many requests under way")
            handler = self._handlers.get(pdu[0])
            if handler is None:
                raise IllegalFunction(f"function {pdu[0]:02X}h")
            if self._busy_every and pdu[0] not in WHILE_BUSY:
                self._count_towards_busy(now_ns)
            response = handler(pdu, now_ns)
        except Refusal as refusal:
            self.counters.exceptions += 1
            self.counters.busy += isinstance(refusal, DeviceIsBusy)
            self.counters.naks += isinstance(refusal, NegativeAcknowledge)
            return bytes((pdu[0] | 0x80, refusal.code))
        self.diagnostics.completed(pdu)
        return response

    def _count_towards_busy(self, now_ns: int) -> None:
        """Count one more request, and make the unit busy after it if `be_busy_after` requires this."""
        self._answered += 1
        if self._busy_every and self._answered % self._busy_every == 0:
            self._busy_until_ns = max(self._busy_until_ns, now_ns + self._busy_for_ns)

    def _report_server_id(self, pdu: bytes, now_ns: int) -> bytes:
        require_length(pdu, 1)
        indicator = b"\xff" if self.running else b"\x00"  # AP 6.13: server id, run indicator, additional data
        data = (self._server_id or b"") + indicator + self._server_data
        return bytes((pdu[0], len(data))) + data
