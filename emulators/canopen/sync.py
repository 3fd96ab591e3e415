"""The SYNC consumer: which frame is a SYNC, and whether it is a good one (CiA 301 v4.2, 7.2.5, 1005h, 1019h).

The node produces no SYNC: bit 30 of 1005h is refused.
"""

from __future__ import annotations

from collections.abc import Callable

from emulators.canopen import emcy
from emulators.canopen.aborts import Abort, abort
from emulators.canopen.service import Core, Service
from gateway.core.canframe import CanFrame

DEFAULT_COB_ID = 0x80
_GENERATES = 1 << 30


class SyncConsumer(Service):
    """Calls `on_sync(counter, now_ns)` for each good SYNC in OPERATIONAL; `counter` is None where SYNC has none."""

    def __init__(self, core: Core, emergency: emcy.Emergency, on_sync: Callable[[int | None, int], None]) -> None:
        self._core = core
        self._emergency = emergency
        self._on_sync = on_sync

    def owns(self, index: int) -> bool:
        return index in (0x1005, 0x1019)

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        value = int.from_bytes(raw, "little")
        if index == 0x1005 and (value & _GENERATES or value & 0x3FFFF800):
            raise abort(index, subindex, Abort.VALUE)
        if index == 0x1019 and (value == 1 or value > 240):
            raise abort(index, subindex, Abort.VALUE)

    def receive(self, frame: CanFrame, now_ns: int) -> bool:
        """A data frame. Returns whether it is the SYNC, good or not."""
        if frame.can_id != self._core.data.number(0x1005, 0, DEFAULT_COB_ID) & 0x7FF:
            return False
        if not self._core.communicating:
            self._core.counters.ignored += 1
            return True
        counted = self._core.data.number(0x1019) != 0
        if len(frame.data) != (1 if counted else 0):
            self._core.counters.ignored += 1
            self._emergency.report(emcy.SYNC_LENGTH, now_ns, register=emcy.COMMUNICATION)
            return True
        self._core.counters.syncs += 1
        if self._core.operational:
            self._on_sync(frame.data[0] if counted else None, now_ns)
        return True
