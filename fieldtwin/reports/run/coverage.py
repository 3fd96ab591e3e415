"""The coverage of a run: registers and objects, refusals, transitions, faults in states.

`Collector` counts the events of a trace and returns `AccessCounts`, which add up over scenarios. The missing parts are
derived from the profiles when the report is written. The number of counters is limited: those of the system by its contents,
and all others by `MOST`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TypeVar

from fieldtwin.capture.decoding.decoder import Decoder
from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.core.files.profile import RegisterRange
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import MEANINGS
from fieldtwin.results.model import AccessCounts, Machine
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.twin.site.system import System

MOST = 2000
"""Largest number of different entries of one kind that are counted."""

K = TypeVar("K", bound=Hashable)


class Collector:
    """The counters of one run's events. Subscribe `feed` to a trace: then events that a full trace drops are counted too."""

    def __init__(self, system: System | None, machines: Iterable[Machine] = ()) -> None:
        self.counts = AccessCounts()
        self._decoder = Decoder(system)
        self._machines = {m.variable: m for m in machines}
        self._states: dict[str, str] = {}
        self._faults: dict[str, str] = {}

    def feed(self, event: TraceEvent) -> None:
        """Count an event of the trace."""
        self.take(event, self._decoder.feed(event))

    def finish(self) -> AccessCounts:
        """End the run and return its counts."""
        self.add(self._decoder.finish())
        return self.counts

    def add(self, exchanges: Iterable[DecodedExchange]) -> None:
        """Count exchanges that the caller has decoded."""
        for exchange in exchanges:
            self._exchange(exchange)

    def take(self, event: TraceEvent, exchanges: Iterable[DecodedExchange]) -> None:
        """Count an event that the caller has already decoded into `exchanges`."""
        if event.kind is TraceKind.FRAME:
            self.add(exchanges)
        elif event.kind is TraceKind.STATE and event.where in self._machines:
            self._state(event.where, self._machines[event.where].name_of(event.data.get("value")))
        elif event.kind is TraceKind.FAULT:
            self._fault(event.where, str(event.data.get("name", event.where)), bool(event.data.get("on")))

    def _exchange(self, exchange: DecodedExchange) -> None:
        counts, device = self.counts, exchange.device or f"{exchange.bus} {exchange.unit}"
        _count(counts.services, (device, exchange.service))
        if exchange.problem:
            _count(counts.problems, (device, exchange.problem))
        if exchange.exception is not None:
            _count(counts.exceptions, (device, exchange.exception))
        if exchange.abort is not None:
            _count(counts.aborts, (device, exchange.abort))
        if exchange.device:
            for span in exchange.spans:
                touched = counts.touched if exchange.ok else counts.refused
                _count(touched, (exchange.device, span.access, span.table, span.address, span.count, span.subindex))

    def _state(self, variable: str, state: str) -> None:
        before = self._states.get(variable)
        self._states[variable] = state
        if before is not None and before != state:
            _count(self.counts.transitions, (variable, before, state))
        for name in self._faults.values():
            _count(self.counts.pairs, (name, variable, state))

    def _fault(self, id: str, name: str, on: bool) -> None:
        if not on:
            self._faults.pop(id, None)
            return
        self._faults[id] = name
        _count(self.counts.faults, name)
        for variable, machine in self._machines.items():
            state = self._states.get(variable, machine.states[0] if machine.states else "")
            _count(self.counts.pairs, (name, variable, state))


def _count(counter: Counter[K], key: K) -> None:
    if key in counter or len(counter) < MOST:
        counter[key] += 1


@dataclass(frozen=True, slots=True)
class TagCoverage:
    """A tag of a device: how often it was read, written and refused, and whether it can be read and written at all."""

    name: str
    where: str
    readable: bool
    writable: bool
    read: int
    written: int
    refused: int

    @property
    def missing(self) -> list[str]:
        """Return the accesses (``read``, ``written``) that are possible and never happened."""
        missing = ["read"] if self.readable and not self.read else []
        return missing + (["written"] if self.writable and not self.written else [])


@dataclass(frozen=True)
class DeviceCoverage:
    """A device: its tags, and how often anything else was accessed, as text."""

    device: str
    profile: str
    places: tuple[TagCoverage, ...]
    others: tuple[tuple[str, int], ...] = field(default=())

    def share(self, what: str) -> tuple[int, int]:
        """Return how many tags were ``read`` or ``written``, and how many can be."""
        able = [p for p in self.places if (p.readable if what == "read" else p.writable)]
        return sum(what not in p.missing for p in able), len(able)


def devices_covered(system: System, counts: AccessCounts) -> list[DeviceCoverage]:
    """Return the coverage of every device of the system. A longer read that includes a tag's registers counts for the tag."""
    return [_device(config, counts) for config in system.devices.values()]


def _device(config: DeviceConfig, counts: AccessCounts) -> DeviceCoverage:
    touched = {key: n for key, n in counts.touched.items() if key[0] == config.name}
    refused = {key: n for key, n in counts.refused.items() if key[0] == config.name}
    places, known = [], set()
    for name, at, readable, writable in _things(config):
        read = {key: n for key, n in touched.items() if key[1] == "read" and _covers(key, at)}
        written = {key: n for key, n in touched.items() if key[1] == "write" and _covers(key, at)}
        known |= read.keys() | written.keys()
        failed = sum(n for key, n in refused.items() if _covers(key, at))
        where = str(at) if isinstance(at, RegisterRange) else f"{at[0]:04X}h:{at[1]:02X}"
        places.append(TagCoverage(name, where, readable, writable, sum(read.values()), sum(written.values()), failed))
    others = sorted((_where(key), n) for key, n in touched.items() if key not in known)
    return DeviceCoverage(config.name, config.profile.name, tuple(places), tuple(others))


_Key = tuple[str, str, str, int, int, int]


def _things(config: DeviceConfig) -> Iterator[tuple[str, RegisterRange | tuple[int, int], bool, bool]]:
    """Yield the tags of a device, and the first two registers and the acknowledgement of each of its mailboxes.

    Each entry has the name, the registers or the object, whether it can be read, and whether it can be written.
    """
    profile = config.profile
    for tag in profile.tags.values():
        yield tag.name, tag.at or tag.object or (0, 0), tag.readable, tag.name in config.writable
    for box in (profile.inbox, profile.outbox):
        if box is not None:
            incoming = box is profile.inbox
            yield box.name, replace(box.at, count=2), incoming, box.name in config.writable
            ack = f"{box.name}_ack"
            yield ack, box.ack, not incoming, ack in config.writable


def _covers(key: _Key, at: RegisterRange | tuple[int, int]) -> bool:
    _, _, table, address, count, subindex = key
    if isinstance(at, tuple):
        return table == "object" and at == (address, subindex)
    return table == at.table and address <= at.address and at.end <= address + count


def _where(key: _Key) -> str:
    _, access, table, address, count, subindex = key
    if table == "object":
        return f"{access} {address:04X}h:{subindex:02X}"
    return f"{access} {table}:{address}" + (f" x {count}" if count != 1 else "")


def exceptions_missing(counts: AccessCounts) -> list[int]:
    """Return the exception codes of the standard that no device sent."""
    seen = {code for _, code in counts.exceptions}
    return [code for code in ModbusExceptionReply.NAMES if code not in seen]


def aborts_missing(counts: AccessCounts) -> list[int]:
    """Return the abort codes of the standard that no device sent."""
    seen = {code for _, code in counts.aborts}
    return [code for code in MEANINGS if code not in seen]
