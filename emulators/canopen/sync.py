"""SYNC: consumer, producer, counter and window (CiA 301 v4.2, 7.2.5; 1005h, 1006h, 1007h, 1019h).

A node with a cycle period (1006h) that receives no SYNC for one and a half periods reports 8100h until SYNC returns; the standard
defines no specific code for that. The window (1007h) limits synchronous PDOs: an RPDO that arrives after its end is refused, and
a TPDO that is not on the bus by its end is dropped.
"""

from __future__ import annotations

from collections.abc import Callable

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.emulators.canopen.errors import emcy
from fieldtwin.emulators.canopen.service import NEVER, Core, NmtState, NodeService
from fieldtwin.gateway.core.canframe import CanFrame

DEFAULT_COB_ID = 0x80
COB_ID, CYCLE, WINDOW, OVERFLOW = 0x1005, 0x1006, 0x1007, 0x1019
_GENERATES = 1 << 30
_NS_PER_US = 1000
_SOURCE = "sync"


class Sync(NodeService):
    """The SYNC service. It calls `on_sync(counter, now_ns)` for each valid SYNC in OPERATIONAL, also for one that it produces.

    `counter` is None without 1019h.
    """

    def __init__(self, core: Core, emergency: emcy.Emergency, on_sync: Callable[[int | None, int], None]) -> None:
        self._core = core
        self._emergency = emergency
        self._on_sync = on_sync
        self._last_ns: int | None = None
        self._late_reported = False
        self._missing_at_ns = self._send_at_ns = NEVER
        self._counter = 1
        self._was_stopped = False

    @property
    def waits(self) -> bool:
        return self._core.data.has(CYCLE)

    def owns(self, index: int) -> bool:
        return index in (COB_ID, CYCLE, WINDOW, OVERFLOW)

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        value = int.from_bytes(raw, "little")
        if index == COB_ID:
            changed_while_running = self._generates and value & _GENERATES and value != self._core.data.number(COB_ID)
            impossible = value & _GENERATES and not self._core.data.has(CYCLE)
            if value & 0x3FFFF800 or changed_while_running or impossible:
                raise abort(index, subindex, Abort.VALUE)
        if index == OVERFLOW:
            if value == 1 or value > 240:
                raise abort(index, subindex, Abort.VALUE)
            if self._cycle_ns:
                raise abort(index, subindex, Abort.DEVICE_STATE)

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        if index == COB_ID:
            self._counter = 1
        if index in (COB_ID, CYCLE):
            self._missing_at_ns = NEVER
            self._emergency.clear_error(emcy.COMMUNICATION_ERROR, now_ns, source=_SOURCE)
            self._schedule(now_ns)

    def reset(self, now_ns: int) -> None:
        self._last_ns = None
        self._missing_at_ns = self._send_at_ns = NEVER
        self._counter = 1

    def state_changed(self, now_ns: int) -> None:
        """Restart the producer's counter at 1 after STOPPED.

        In STOPPED, where the node receives no SYNC, it does not report a missing one.
        """
        if not self._core.communicating:
            self._send_at_ns = self._missing_at_ns = NEVER
        elif self._send_at_ns == NEVER:
            self._schedule(now_ns)
        if self._was_stopped:
            self._counter = 1
        self._was_stopped = self._core.state is NmtState.STOPPED

    def receive(self, frame: CanFrame, now_ns: int) -> bool:
        """Process a data frame. Returns whether it is the SYNC, valid or not."""
        if frame.can_id != self._can_id:
            return False
        if not self._core.communicating:
            self._core.counters.ignored += 1
            return True
        counted = self._core.data.number(OVERFLOW) != 0
        if len(frame.data) != (1 if counted else 0):
            self._core.counters.ignored += 1
            self._emergency.report(emcy.SYNC_LENGTH, now_ns, register=emcy.COMMUNICATION)
            return True
        self._take(frame.data[0] if counted else None, now_ns)
        return True

    def in_window(self, now_ns: int) -> bool:
        """Return whether `now_ns` is inside the window of this cycle. The first PDO that is late in a cycle is reported."""
        end_ns = self.window_end_ns
        if end_ns is None or now_ns <= end_ns:
            return True
        self.late(now_ns)
        return False

    def late(self, now_ns: int) -> None:
        """Report that a synchronous PDO missed the window, once per cycle."""
        if not self._late_reported:
            self._late_reported = True
            self._emergency.report(emcy.COMMUNICATION_ERROR, now_ns, register=emcy.COMMUNICATION)

    @property
    def window_end_ns(self) -> int | None:
        """Return when the window of the last SYNC ends; None without a window."""
        window_ns = self._core.data.number(WINDOW) * _NS_PER_US
        return None if not window_ns or self._last_ns is None else self._last_ns + window_ns

    def tick(self, now_ns: int) -> None:
        if now_ns >= self._missing_at_ns:
            self._missing_at_ns = NEVER
            self._emergency.raise_error(emcy.COMMUNICATION_ERROR, now_ns, register=emcy.COMMUNICATION, source=_SOURCE)
        if now_ns >= self._send_at_ns:
            self._produce(now_ns)

    @property
    def due_ns(self) -> int:
        """Return when a SYNC is detected as missing, or must be sent."""
        return self._missing_at_ns if self._missing_at_ns < self._send_at_ns else self._send_at_ns

    @property
    def _can_id(self) -> int:
        return self._core.data.number(COB_ID, 0, DEFAULT_COB_ID) & 0x7FF

    @property
    def _generates(self) -> bool:
        return bool(self._core.data.number(COB_ID) & _GENERATES)

    @property
    def _cycle_ns(self) -> int:
        return self._core.data.number(CYCLE) * _NS_PER_US

    def _schedule(self, now_ns: int) -> None:
        producing = self._generates and self._cycle_ns and self._core.communicating
        self._send_at_ns = now_ns + self._cycle_ns if producing else NEVER

    def _produce(self, now_ns: int) -> None:
        due_ns, cycle_ns = self._send_at_ns, self._cycle_ns
        self._send_at_ns = max(due_ns + cycle_ns, now_ns + 1)
        if due_ns + cycle_ns <= now_ns:  # late by more than a cycle: skip SYNCs, and never send several at once
            self._send_at_ns = now_ns + cycle_ns
        overflow = self._core.data.number(OVERFLOW)
        counter = self._counter if overflow else None
        self._counter = self._counter % overflow + 1 if overflow else 1
        self._core.send(self._can_id, b"" if counter is None else bytes([counter]), now_ns)
        self._take(counter, now_ns)

    def _take(self, counter: int | None, now_ns: int) -> None:
        self._core.counters.syncs += 1
        self._last_ns = now_ns
        self._late_reported = False
        watched = self._cycle_ns and not self._generates
        self._missing_at_ns = now_ns + self._cycle_ns * 3 // 2 if watched else NEVER
        self._emergency.clear_error(emcy.COMMUNICATION_ERROR, now_ns, source=_SOURCE)
        if self._core.operational:
            self._on_sync(counter, now_ns)
