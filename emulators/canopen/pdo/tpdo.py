"""Transmit PDOs: when each is sent and with what data (CiA 301 v4.2, 7.2.2 and 7.5.2.37).

Transmission types: 0 sends at the SYNC after an event, 1 to 240 at every n-th SYNC, 254 and 255 on an event. 252 and 253 send on
a remote frame: 252 the values sampled at the last SYNC, 253 the present values. Events are: the event timer, a change of a mapped
value, the activation of the PDO. Inhibit time and event timer apply only to event-driven PDOs.

A PDO that SYNC triggered is late if it still waits for the bus at the end of the synchronous window (1007h):
`take_overdue` returns its identifier, and the owner of the transmit queue withdraws it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass

from fieldtwin.emulators.canopen.eds.dictionary import Key
from fieldtwin.emulators.canopen.pdo.parameters import COB_ID, EVENT, MAPPING_OFFSET, TYPE, PdoParameters, pdo_indices
from fieldtwin.emulators.canopen.service import NEVER, Core, NodeService, SentPdo
from fieldtwin.gateway.core.canframe import CanFrame

SAMPLED, REMOTE = 252, 253
_FIRST = 0x1800


@dataclass(slots=True)
class _Tpdo:
    parameters: PdoParameters
    pending: bool = False
    event_at_ns: int | None = None
    free_at_ns: int = 0
    """The end of the inhibit time (ns)."""
    syncs: int = 0
    started: bool = False
    """Whether the SYNC whose counter equals the start value has occurred."""
    sample: bytes | None = None

    def due_ns(self) -> int:
        """Return when an event-driven PDO must be sent next."""
        settings = self.parameters.settings
        if settings.type < 254 or not settings.valid:
            return NEVER
        if self.pending:
            return self.free_at_ns
        return NEVER if self.event_at_ns is None else max(self.event_at_ns, self.free_at_ns)


class Tpdos(NodeService):
    """All TPDOs of a node."""

    def __init__(self, core: Core, window_end_ns: Callable[[], int | None]) -> None:
        self._core = core
        self._window_end_ns = window_end_ns
        self._of_sync: set[int] = set()  # identifiers sent because of the last SYNC, until its window ends
        self._overdue: frozenset[int] = frozenset()
        self._event_ns = NEVER
        self._event_of = -1
        """The version of the values from which `_event_ns` was computed; -1 after a change of a TPDO's state."""
        self._tpdos = [_Tpdo(PdoParameters(core.data, index)) for index in pdo_indices(core.data, _FIRST)]

    @property
    def waits(self) -> bool:
        return bool(self._tpdos)

    def owns(self, index: int) -> bool:
        return _FIRST <= index < _FIRST + 2 * MAPPING_OFFSET

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        parameters = PdoParameters(self._core.data, index if index < 0x1A00 else index - MAPPING_OFFSET)
        if index == parameters.index:
            parameters.check_communication(subindex, raw)
        else:
            parameters.check_mapping(subindex, raw)

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        for tpdo in self._tpdos:
            if tpdo.parameters.index != index:
                continue
            if subindex in (COB_ID, TYPE):
                self._activate(tpdo, now_ns)
            elif subindex == EVENT:
                event_ns = tpdo.parameters.settings.event_ns
                tpdo.event_at_ns = now_ns + event_ns if event_ns and self._core.operational else None
                self._event_of = -1

    def reset(self, now_ns: int) -> None:
        self._of_sync.clear()
        self._overdue = frozenset()
        for tpdo in self._tpdos:
            tpdo.free_at_ns = 0
            self._activate(tpdo, now_ns)

    def state_changed(self, now_ns: int) -> None:
        for tpdo in self._tpdos:
            self._activate(tpdo, now_ns)

    def changed(self, keys: Iterable[Key], now_ns: int) -> None:
        """Process values that changed inside the device. A change is an event for the PDOs that map the value."""
        if self._core.operational:
            keys = set(keys)
            for tpdo in self._tpdos:
                if not keys.isdisjoint(tpdo.parameters.settings.keys):
                    tpdo.pending = True
                    self._event_of = -1

    def tick(self, now_ns: int) -> None:
        end_ns = self._end_of_window()
        if end_ns is not None and now_ns > end_ns:
            self._overdue = frozenset(self._of_sync)
            self._of_sync.clear()
        if not self._core.operational or self._core.mutes:
            return
        for tpdo in self._tpdos:
            if now_ns >= tpdo.due_ns():
                self._send_event(tpdo, now_ns)

    @property
    def due_ns(self) -> int:
        """Return when an event must be sent, or the synchronous window ends."""
        core, due_ns = self._core, NEVER
        if core.operational and not core.mutes:
            if self._event_of != core.data.version:
                self._event_ns = min((tpdo.due_ns() for tpdo in self._tpdos), default=NEVER)
                self._event_of = core.data.version
            due_ns = self._event_ns
        if self._of_sync and (end_ns := self._end_of_window()) is not None:
            due_ns = min(due_ns, end_ns + 1)
        return due_ns

    def take_overdue(self) -> frozenset[int]:
        """Return the identifiers of the PDOs that the last SYNC triggered, after the end of its window and once per SYNC."""
        overdue, self._overdue = self._overdue, frozenset()
        return overdue

    def dropped(self, frames: Iterable[CanFrame]) -> None:
        """Subtract frames that were never sent on the bus from the count of sent frames."""
        for frame in frames:
            self._core.counters.tpdos_late += 1
            self._core.counters.tpdos -= 1
            self._core.counters.frames_out -= 1
            with suppress(ValueError):  # the journal is bounded
                self._core.journal.remove(SentPdo(frame.t_ns, frame.can_id, frame.data))

    def on_sync(self, counter: int | None, now_ns: int) -> None:
        """Process a SYNC in OPERATIONAL; `counter` is its counter if it carries one."""
        self._of_sync.clear()
        self._overdue = frozenset()
        for tpdo in self._tpdos:
            if tpdo.parameters.settings.valid:
                self._on_sync(tpdo, counter, now_ns)

    def on_remote(self, can_id: int, now_ns: int) -> bool:
        """Process a remote frame, and queue the answer if the TPDO allows it. Return whether it requests a TPDO of this node."""
        for tpdo in self._tpdos:
            settings = tpdo.parameters.settings
            if settings.valid and settings.can_id == can_id:
                if settings.remote_allowed and self._core.operational:
                    self._transmit(tpdo, tpdo.sample if settings.type == SAMPLED else None, now_ns)
                return True
        return False

    def _activate(self, tpdo: _Tpdo, now_ns: int) -> None:
        """Restart the counters; becoming active is an event. The inhibit time of PDOs already sent continues."""
        active = self._core.operational and tpdo.parameters.settings.valid
        self._event_of = -1
        tpdo.pending = active
        tpdo.event_at_ns = None
        tpdo.syncs = 0
        tpdo.started = False
        tpdo.sample = None

    def _on_sync(self, tpdo: _Tpdo, counter: int | None, now_ns: int) -> None:
        settings = tpdo.parameters.settings
        kind = settings.type
        if kind == 0:
            if tpdo.pending:
                tpdo.pending = False
                self._transmit_for_sync(tpdo, now_ns)
        elif kind == SAMPLED:
            tpdo.sample = self._build(tpdo, now_ns)
        elif kind <= 240:
            start = settings.sync_start
            if counter is not None and start and not tpdo.started and counter != start:
                return
            tpdo.started = True
            tpdo.syncs += 1
            if tpdo.syncs >= kind:
                tpdo.syncs = 0
                self._transmit_for_sync(tpdo, now_ns)

    def _end_of_window(self) -> int | None:
        return self._window_end_ns() if self._of_sync else None

    def _transmit_for_sync(self, tpdo: _Tpdo, now_ns: int) -> None:
        self._of_sync.add(tpdo.parameters.settings.can_id)
        self._transmit(tpdo, None, now_ns)

    def _send_event(self, tpdo: _Tpdo, now_ns: int) -> None:
        settings = tpdo.parameters.settings
        event_ns = settings.event_ns
        on_time = not tpdo.pending and tpdo.event_at_ns is not None
        # The timer keeps its grid, so that delays do not add up; after any other event it restarts.
        next_ns = (tpdo.event_at_ns or 0) + event_ns if on_time else now_ns + event_ns
        tpdo.event_at_ns = (next_ns if next_ns > now_ns else now_ns + event_ns) if event_ns else None
        tpdo.pending = False
        tpdo.free_at_ns = now_ns + settings.inhibit_ns
        self._event_of = -1
        self._transmit(tpdo, None, now_ns)

    def _transmit(self, tpdo: _Tpdo, data: bytes | None, now_ns: int) -> None:
        data = self._build(tpdo, now_ns) if data is None else data
        if not data or self._core.mutes:
            return  # nothing is mapped: the PDO is empty and is not sent
        can_id = tpdo.parameters.settings.can_id
        self._core.counters.tpdos += 1
        self._core.journal.append(SentPdo(now_ns, can_id, data))
        self._core.send(can_id, data, now_ns)
        if self._core.given is not None:
            self._core.given([mapped.key for mapped in tpdo.parameters.settings.mapping], now_ns)

    def _build(self, tpdo: _Tpdo, now_ns: int) -> bytes:
        self._core.refresh(now_ns)
        settings = tpdo.parameters.settings
        if settings.whole:
            return self._core.data.joined(settings.keys)
        packed, position = 0, 0
        for mapped in settings.mapping:
            packed |= (self._core.data.number(*mapped.key) & ((1 << mapped.bits) - 1)) << position
            position += mapped.bits
        return packed.to_bytes((position + 7) // 8, "little")
