"""Receive PDOs: taking values from the bus (CiA 301 v4.2, 7.2.2 and 7.5.2.35 to 36).

With transmission types 254 and 255 a PDO is applied immediately, with 0 to 240 at the next SYNC. A PDO that is too short causes
EMCY 8210h and is not applied. If a PDO is too long, its first bytes are used. If a PDO does not arrive again within its
event timer, EMCY 8250h is active until it arrives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from fieldtwin.emulators.canopen.eds.dictionary import Key
from fieldtwin.emulators.canopen.errors import emcy
from fieldtwin.emulators.canopen.pdo.parameters import COB_ID, EVENT, MAPPING_OFFSET, PdoParameters, pdo_indices
from fieldtwin.emulators.canopen.service import NEVER, Core, NodeService
from fieldtwin.gateway.core.errors import SdoAborted

_FIRST = 0x1400


@dataclass(slots=True)
class _Rpdo:
    parameters: PdoParameters
    waiting: bytes | None = None
    """The received data that is applied at the next SYNC. A newer PDO replaces it."""
    deadline_ns: int = NEVER
    """The time by which the next PDO must arrive; `NEVER` before the first one."""

    @property
    def source(self) -> str:
        """Return the error source of a timeout."""
        return f"{self.parameters.index:04X}h"


class Rpdos(NodeService):
    """All RPDOs of a node.

    For each PDO, `changed` is called with the objects whose values it changed, then `wrote` with all objects that it contained.
    """

    due_ns: int = NEVER
    """The time of the first timeout."""

    def __init__(
        self,
        core: Core,
        emergency: emcy.Emergency,
        changed: Callable[[list[Key], int], None],
        wrote: Callable[[list[Key], int], None],
        in_window: Callable[[int], bool],
    ) -> None:
        self._in_window = in_window
        self._core = core
        self._emergency = emergency
        self._changed = changed
        self._wrote = wrote
        self._rpdos = [_Rpdo(PdoParameters(core.data, index)) for index in pdo_indices(core.data, _FIRST)]

    @property
    def waits(self) -> bool:
        return bool(self._rpdos)

    def owns(self, index: int) -> bool:
        return _FIRST <= index < _FIRST + 2 * MAPPING_OFFSET

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        parameters = PdoParameters(self._core.data, index if index < 0x1600 else index - MAPPING_OFFSET)
        if index == parameters.index:
            parameters.check_communication(subindex, raw)
        else:
            parameters.check_mapping(subindex, raw)

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        for rpdo in self._rpdos:
            if rpdo.parameters.index == index and subindex == COB_ID:
                rpdo.waiting = None
            if rpdo.parameters.index == index and subindex in (COB_ID, EVENT):
                self._stop_watching(rpdo, now_ns)
        self._find_due()

    def reset(self, now_ns: int) -> None:
        self._forget(now_ns)

    def state_changed(self, now_ns: int) -> None:
        self._forget(now_ns)

    def tick(self, now_ns: int) -> None:
        for rpdo in self._rpdos:
            if now_ns >= rpdo.deadline_ns:
                rpdo.deadline_ns = NEVER
                self._emergency.raise_error(emcy.RPDO_TIMEOUT, now_ns, register=emcy.COMMUNICATION, source=rpdo.source)
        self._find_due()

    def _find_due(self) -> None:
        self.due_ns = min((rpdo.deadline_ns for rpdo in self._rpdos), default=NEVER)

    def receive(self, can_id: int, payload: bytes, now_ns: int) -> bool:
        """Process a data frame. Returns whether it is an RPDO of this node, applied or not."""
        mine = [r for r in self._rpdos if (s := r.parameters.settings).valid and s.can_id == can_id]
        for rpdo in mine:
            if not self._core.operational:
                self._core.counters.ignored += 1
                continue
            settings = rpdo.parameters.settings
            if len(payload) < settings.length:
                self._core.counters.rpdos_refused += 1
                self._emergency.report(emcy.PDO_TOO_SHORT, now_ns, register=emcy.COMMUNICATION)
                continue
            rpdo.deadline_ns = now_ns + settings.event_ns if settings.event_ns else NEVER
            self._find_due()
            self._emergency.clear_error(emcy.RPDO_TIMEOUT, now_ns, source=rpdo.source)
            if settings.type > 240:
                self._apply(rpdo, payload, now_ns)
            elif self._in_window(now_ns):
                rpdo.waiting = payload
            else:
                self._core.counters.rpdos_refused += 1
        return bool(mine)

    def on_sync(self, now_ns: int) -> None:
        """Apply the waiting PDOs at a SYNC in OPERATIONAL."""
        for rpdo in self._rpdos:
            if rpdo.waiting is not None:
                payload, rpdo.waiting = rpdo.waiting, None
                self._apply(rpdo, payload, now_ns)

    def _forget(self, now_ns: int) -> None:
        for rpdo in self._rpdos:
            rpdo.waiting = None
            self._stop_watching(rpdo, now_ns)
        self._find_due()

    def _stop_watching(self, rpdo: _Rpdo, now_ns: int) -> None:
        rpdo.deadline_ns = NEVER
        self._emergency.clear_error(emcy.RPDO_TIMEOUT, now_ns, source=rpdo.source)

    def _apply(self, rpdo: _Rpdo, payload: bytes, now_ns: int) -> None:
        """Apply all values or none. If a value is outside its limits, the whole PDO is refused and counted."""
        data = self._core.data
        packed, position = int.from_bytes(payload, "little"), 0
        values: list[tuple[Key, bytes]] = []
        for mapped in rpdo.parameters.settings.mapping:
            value = packed >> position & ((1 << mapped.bits) - 1)
            position += mapped.bits
            entry = data.dictionary.entry(*mapped.key)
            if entry is None or entry.size is None:
                continue  # a dummy: padding without an object
            raw = value.to_bytes(max(entry.size, (mapped.bits + 7) // 8), "little")[: entry.size]
            try:
                data.check_value(entry, raw)
            except SdoAborted:
                self._core.counters.rpdos_refused += 1
                return
            values.append((mapped.key, raw))
        self._core.counters.rpdos += 1
        changed = [key for key, raw in values if data.put(*key, raw)]
        for key, raw in values:
            self._core.note(now_ns, "rpdo", *key, raw)
        self._changed(changed, now_ns)
        self._wrote([key for key, _ in values], now_ns)
