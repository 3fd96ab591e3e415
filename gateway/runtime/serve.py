"""The process image as Modbus TCP registers, for HMIs and other controllers (`serve` section of a system file).

A bad value must never look good. A read that includes a bad tag is refused with exception 04; or, if the file asks for
it, a bad float is NaN and its quality register holds the reason. An uncertain value is returned only if the tag has a
quality register. Part of a value is never returned or accepted, because two reads could belong to two samples. Writes
go through the output writer's checks and the audit log; no other register can be written.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Literal, Protocol

from fieldtwin.gateway.connections.sockets.listeners import TcpListener
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import Listen
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import EndpointBusy, FieldtwinError, ModbusExceptionReply, NotAllowed
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.protocols.modbus.requests.refusals import refusal
from fieldtwin.gateway.protocols.modbus.server.analysis import (
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    NO_PATH,
    SERVER_BUSY,
    SERVER_FAILURE,
    WRITE_FUNCTIONS,
    Access,
    ServedTable,
    examine,
    exception_pdu,
)
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.bridge.audit import WriteRecord
from fieldtwin.gateway.runtime.bridge.policy import EVERYONE, Network, within
from fieldtwin.gateway.runtime.bridge.tcp import Answer, Caller, TcpFront
from fieldtwin.gateway.runtime.gateway_status import ServerStatus
from fieldtwin.gateway.runtime.plc_variables import PlcVariables
from fieldtwin.gateway.runtime.serve_codec import REGISTERS, not_a_number, pack, unpack
from fieldtwin.gateway.runtime.tags import TagTable

MAX_REGISTERS = 4
"""The number of registers of the largest value."""
BIT_TABLES = ("coil", "discrete")
DIRECT_UNITS = (0, 255)
"""The unit IDs that a client without unit IDs sends to a device directly on TCP (TG 4.4.1.2, case MB-057)."""

QUALITY_TABLE: Mapping[ServedTable, ServedTable] = {
    "input": "input",
    "holding": "holding",
    "discrete": "input",
    "coil": "holding",
}


@dataclass(frozen=True, slots=True)
class ServedTag:
    """A served tag and its address.

    `quality_at` is the address of its quality register, in the table given by `QUALITY_TABLE`. `from_plc`: the PLC publishes
    the tag. `variable` is ``program.variable`` of the PLC if clients write that variable instead of a tag, within `limits`. A
    served tag with a `constant` always has this value.
    """

    tag: str
    table: ServedTable
    address: int
    type: str = "float32"
    order: str = "ABCD"
    quality_at: int | None = None
    write: bool = False
    from_plc: bool = False
    variable: str = ""
    limits: tuple[float, float] | None = None
    constant: float | None = None

    @property
    def count(self) -> int:
        """Return the number of registers or bits that the tag occupies."""
        return 1 if self.table in BIT_TABLES else REGISTERS[self.type]


@dataclass(frozen=True)
class ServeConfig:
    """The configuration of one server. With `if_bad` "nan", a bad float reads as NaN; no other type has a value for that purpose.

    Clients whose certificate has one of `roles` (MBTLS 8.4) may read, and those with one of `write_roles` may also write; None:
    every client, also without a certificate. A client that is silent for `idle_s` is disconnected; 0: never. `sizes`: the number
    of registers or bits of each table that always exist; those without a tag read as 0, and writes to them have no effect.
    """

    name: str
    listen: Endpoint
    unit: int
    tags: tuple[ServedTag, ...]
    if_bad: Literal["exception", "nan"] = "exception"
    networks: tuple[Network, ...] = EVERYONE
    clients: int = 16
    roles: frozenset[str] | None = None
    write_roles: frozenset[str] | None = None
    idle_s: float = 0.0
    sizes: Mapping[ServedTable, int] = field(default_factory=dict)


class OutputWrites(Protocol):
    """The interface to the output writer, which carries out the clients' writes."""

    def request(self, tag: str, value: float, by: str, done: Callable[[FieldtwinError | None], None]) -> None:
        """Write a tag once; `done` is called with the result."""
        ...


@dataclass
class ServeCounters:
    """Counters: answered reads, reads refused because of a bad tag, requests refused for another reason, and completed writes."""

    reads: int = 0
    bad: int = 0
    refused: int = 0
    writes: int = 0


@dataclass(frozen=True, slots=True)
class _Cell:
    """The content at an address: a tag's value, or the quality register of a tag."""

    served: ServedTag
    is_quality: bool

    @property
    def count(self) -> int:
        return 1 if self.is_quality else self.served.count


class TagServer:
    """A server of tags on one port, which runs until cancelled."""

    def __init__(
        self,
        config: ServeConfig,
        tags: TagTable,
        writer: OutputWrites,
        clock: Clock,
        listen: Listen = TcpListener.open,
        audit: AuditLog | None = None,
        plc: PlcVariables | None = None,
    ) -> None:
        """Create the server.

        `audit` records the writes that are refused before they reach `writer`, which records its own refusals, and the writes of
        variables of the PLC. `plc` is necessary for tags `from_plc`.
        """
        self.config = config
        self.counters = ServeCounters()
        self._record = WriteRecord(audit, clock) if audit is not None else None
        self._tags = tags
        self._writer = writer
        self._plc = plc
        self._clock = clock
        self._cells: dict[ServedTable, dict[int, _Cell]] = {t: {} for t in QUALITY_TABLE}
        for served in config.tags:
            self._cells[served.table][served.address] = _Cell(served, is_quality=False)
            if served.quality_at is not None:
                self._cells[QUALITY_TABLE[served.table]][served.quality_at] = _Cell(served, is_quality=True)
        self._writable = {t.table for t in config.tags if t.write}
        self.front = TcpFront(
            config.listen,
            self.ask,
            clock,
            max_clients=config.clients,
            admits=lambda address: within(address, config.networks),
            idle_s=config.idle_s,
            listen=listen,
            refused=self._note_refusal,
        )

    async def run(self) -> None:
        """Serve clients until cancelled."""
        await self.front.run()

    def status(self) -> ServerStatus:
        """Return where the server listens, its clients and its counters."""
        front = self.front.status()
        return ServerStatus(
            listening=front.listening,
            error=front.error,
            clients=front.clients,
            counters={**front.counters, **asdict(self.counters)},
            unit=self.config.unit,
        )

    # -- one request ------------------------------------------------------------------------------------------------

    def ask(self, caller: Caller, unit: int, pdu: bytes) -> Answer:
        """Answer a request PDU. A unit ID that is not served gets exception 0A, because silence would hide a wrong setting."""
        try:
            if unit != self.config.unit and unit not in DIRECT_UNITS:
                raise refusal(pdu[0], NO_PATH, f"the unit ID is {self.config.unit}")
            return self._answer(caller, pdu)
        except ModbusExceptionReply as e:
            self.counters.bad += e.code == SERVER_FAILURE
            self.counters.refused += e.code != SERVER_FAILURE
            self._note_refusal(caller, unit, pdu, e.code, e.hint)
            return exception_pdu(e)

    def _note_refusal(self, caller: Caller, unit: int, pdu: bytes, code: int, why: str = "") -> None:
        """Record a refused write of registers that belong to no writable tag."""
        if self._record is not None and pdu[0] in WRITE_FUNCTIONS:
            self._record.refused(caller.on_record, self.config.name, unit, pdu, code, why)

    def _answer(self, caller: Caller, pdu: bytes) -> Answer:
        function = pdu[0]
        if not _is_one_of(caller.role, self.config.roles):
            raise refusal(function, ILLEGAL_FUNCTION)  # MBTLS 8.5
        if function in (0x01, 0x02, 0x03, 0x04):
            (access,) = examine(pdu).accesses
            data = self._read(function, access)
            self.counters.reads += 1
            return bytes([function, len(data)]) + data
        table: ServedTable = "coil" if function in (0x05, 0x0F) else "holding"
        may_write = table in self._writable and _is_one_of(caller.role, self.config.write_roles)
        if function not in (0x05, 0x06, 0x0F, 0x10) or not may_write:
            raise refusal(function, ILLEGAL_FUNCTION)
        (access,) = examine(pdu).accesses
        return self._write(caller, pdu, access)

    # -- reading ----------------------------------------------------------------------------------------------------

    def _read(self, function: int, access: Access) -> bytes:
        """Return the data of the whole range, or raise the exception reply: a range is never read in part (case MB-041)."""
        now_ns = self._clock.monotonic_ns()
        parts = [self._cell_bytes(function, cell, now_ns) for cell in self._covered(function, access)]
        if access.table not in BIT_TABLES:
            return b"".join(parts)
        packed = bytearray((access.count + 7) // 8)
        for i, part in enumerate(parts):
            packed[i // 8] |= part[-1] << i % 8
        return bytes(packed)

    def _covered(self, function: int, access: Access) -> list[_Cell]:
        """Return the cells of a range.

        A gap in the range, or only a part of a value, gets exception 02 (cases MB-048, MB-049).
        """
        cells, at, end = self._cells[access.table], access.address, access.address + access.count
        found = []
        while at < end:
            cell = cells.get(at)
            if cell is None and at < self.config.sizes.get(access.table, 0) and not self._is_inside(access.table, at):
                kind = "bool" if access.table in BIT_TABLES else "uint16"
                cell = _Cell(ServedTag("", access.table, at, kind, constant=0), is_quality=False)
            if cell is None or at + cell.count > end:
                raise refusal(function, ILLEGAL_ADDRESS)
            found.append(cell)
            at += cell.count
        return found

    def _is_inside(self, table: ServedTable, address: int) -> bool:
        """Return whether a value begins before `address` and ends after it."""
        cells = self._cells[table]
        return any((cell := cells.get(address - n)) is not None and cell.count > n for n in range(1, MAX_REGISTERS))

    def _cell_bytes(self, function: int, cell: _Cell, now_ns: int) -> bytes:
        served = cell.served
        value = self._value(served, now_ns)
        data = pack(served.type, served.order, value.value) if self._presentable(served, value) else None
        if cell.is_quality:
            return _quality_word(value, fits=data is not None).to_bytes(2)
        if data is not None:
            return data
        substitute = not_a_number(served.type, served.order) if self.config.if_bad == "nan" else None
        if substitute is None:
            raise refusal(function, SERVER_FAILURE)
        return substitute

    def _value(self, served: ServedTag, now_ns: int) -> TagValue:
        if served.constant is not None:
            return TagValue(served.constant, Quality.GOOD, t_ns=now_ns)
        if served.from_plc and self._plc is not None:
            return self._plc.current(served.tag)
        return self._tags.current(served.tag, now_ns)

    @staticmethod
    def _presentable(served: ServedTag, value: TagValue) -> bool:
        if value.quality is Quality.UNCERTAIN:
            return served.quality_at is not None
        return value.quality is not Quality.BAD

    # -- writing ----------------------------------------------------------------------------------------------------

    def _write(self, caller: Caller, pdu: bytes, access: Access) -> Answer:
        """Write one whole tag. The client gets the answer when the device has confirmed the write."""
        function = pdu[0]
        cells = self._covered(function, access)
        if any(cell.served.variable for cell in cells):
            return self._write_variables(caller, pdu, access, cells)
        if any(cell.is_quality or not cell.served.write for cell in cells):
            raise refusal(function, ILLEGAL_ADDRESS)
        if len(cells) != 1:
            raise refusal(function, ILLEGAL_VALUE)  # two tags cannot be written as one unit
        served = cells[0].served
        value = unpack(served.type, served.order, _written(pdu, served))
        if value is None:
            raise refusal(function, ILLEGAL_VALUE)
        done, promise = self._promise(pdu)
        self._writer.request(served.tag, value, caller.on_record, done)
        return promise

    def _write_variables(self, caller: Caller, pdu: bytes, access: Access, cells: list[_Cell]) -> Answer:
        """Write variables of the PLC, which take effect together. The client gets the answer after the scan that used them."""
        function = pdu[0]
        if self._plc is None or any(not cell.served.variable and cell.served.tag for cell in cells):
            raise refusal(function, ILLEGAL_ADDRESS)  # a tag that is not a writable variable
        values: dict[str, dict[str, float]] = {}
        for served in (cell.served for cell in cells if cell.served.variable):
            value = unpack(served.type, served.order, _part(pdu, served, access))
            if value is None or (served.limits and not served.limits[0] <= value <= served.limits[1]):
                raise refusal(function, ILLEGAL_VALUE)
            program, _, name = served.variable.partition(".")
            values.setdefault(program, {})[name] = bool(value) if served.type == "bool" else value
        if self._record is not None:
            self._record.asked(caller.on_record, self.config.name, self.config.unit, pdu)
        done, promise = self._promise(pdu)
        self._plc.request(values, done)
        return promise

    def _promise(self, pdu: bytes) -> tuple[Callable[[FieldtwinError | None], None], asyncio.Future[bytes | None]]:
        """Return the function that completes a write, and the answer to the write, which it sets."""
        promise: asyncio.Future[bytes | None] = asyncio.get_running_loop().create_future()

        def done(error: FieldtwinError | None) -> None:
            self.counters.writes += error is None
            self.counters.refused += error is not None
            if not promise.done():
                code = _code_of(error) if error is not None else 0
                promise.set_result(exception_pdu(refusal(pdu[0], code)) if code else pdu[:5])

        return done, promise


def _is_one_of(role: str, roles: frozenset[str] | None) -> bool:
    return roles is None or role in roles


def _written(pdu: bytes, served: ServedTag) -> bytes:
    """Return the register bytes of a write request; a bit becomes one register."""
    if pdu[0] == 0x05:
        return bytes([0, pdu[3] == 0xFF])
    if pdu[0] == 0x0F:
        return bytes([0, pdu[6] & 1])
    return pdu[3:] if pdu[0] == 0x06 else pdu[6:]


def _part(pdu: bytes, served: ServedTag, access: Access) -> bytes:
    """Return the register bytes of one value of a write request; a bit becomes one register."""
    if pdu[0] in (0x05, 0x06):
        return _written(pdu, served)
    at = served.address - access.address
    if pdu[0] == 0x0F:
        return bytes([0, pdu[6 + at // 8] >> at % 8 & 1])
    return pdu[6 + 2 * at : 6 + 2 * (at + served.count)]


def _code_of(error: FieldtwinError) -> int:
    """Return the exception code for a write that was not carried out."""
    if isinstance(error, NotAllowed):
        return ILLEGAL_VALUE
    return SERVER_BUSY if isinstance(error, EndpointBusy) else SERVER_FAILURE


def _quality_word(value: TagValue, *, fits: bool) -> int:
    """Return 0 for good, else the quality in the high byte and the reason in the low byte. A value that the type cannot
    hold is bad."""
    if value.good and not fits:
        return Quality.BAD << 8 | Reason.OUT_OF_RANGE
    return value.quality << 8 | value.reason
