"""The emergency producer: EMCY messages, error register 1001h, history 1003h, inhibit time 1015h (CiA 301, 7.2.7).

It decides when a message may be sent; other services report the errors.
"""

from __future__ import annotations

from collections import deque

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.emulators.canopen.service import NEVER, Core, NodeService

COMMUNICATION_ERROR = 0x8100
HEARTBEAT_LOST = 0x8130
PDO_TOO_SHORT = 0x8210
SYNC_LENGTH = 0x8240
RPDO_TIMEOUT = 0x8250

GENERIC = 0x01
COMMUNICATION = 0x10
"""Bits of the error register (CiA 301, table 51)."""

MAX_WAITING = 32
"""The number of messages that may wait for the end of the inhibit time. Further messages are dropped and counted."""

_INVALID = 1 << 31
_UNIT_NS = 100_000
"""1015h and the inhibit times of PDOs count in units of 100 microseconds."""


class Emergency(NodeService):
    """The EMCY service of a node.

    It keeps the active errors by code and source, because two sources can have the same error (two missing heartbeats). The error
    register is the union of the bits of the active errors.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._active: dict[tuple[int, str], int] = {}
        self._waiting: deque[bytes] = deque()
        self._free_at_ns = 0
        """The end of the inhibit time (ns)."""
        self.active: tuple[int, ...] = ()
        """Codes of the errors that are present, oldest first."""

    def raise_error(
        self, code: int, now_ns: int, *, register: int = GENERIC, info: bytes = b"", source: str = ""
    ) -> None:
        """Report a new error in register, history and message. `info` is the manufacturer's field, at most 5 bytes.

        An error that is already active from the same source is not new and sends nothing.
        """
        if (code, source) not in self._active:
            self._active[code, source] = register | GENERIC
            self._tell_active()
            self.report(code, now_ns, register=register, info=info)

    def report(self, code: int, now_ns: int, *, register: int = GENERIC, info: bytes = b"") -> None:
        """Report an error that does not stay active (such as a PDO that is too short), only in history and message."""
        info = info[:5].ljust(5, b"\0")
        bits = self._update_register() | register | GENERIC
        self._remember(code | int.from_bytes(info[:2], "little") << 16)
        self._emit(code.to_bytes(2, "little") + bytes([bits]) + info, now_ns)

    def clear_error(self, code: int, now_ns: int, *, source: str = "") -> None:
        """Report that an error is repaired, with 0000h and the remaining bits of the register.

        This has no effect if the error was not active.
        """
        if self._active.pop((code, source), None) is not None:
            self._tell_active()
            self._emit(bytes([0, 0, self._update_register(), 0, 0, 0, 0, 0]), now_ns)

    @property
    def waits(self) -> bool:
        return self._core.data.has(0x1014)

    def owns(self, index: int) -> bool:
        return index in (0x1003, 0x1014, 0x1015)

    def check_read(self, index: int, subindex: int) -> None:
        if index == 0x1003 and subindex > self._core.data.number(0x1003):
            raise abort(index, subindex, Abort.NO_DATA)

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        value = int.from_bytes(raw, "little")
        if index == 0x1003 and (subindex != 0 or value != 0):
            raise abort(index, subindex, Abort.VALUE)
        if index == 0x1014:
            old = self._core.data.number(0x1014)
            both_valid = not (old | value) & _INVALID
            if value & 0x7FFFF800 or (both_valid and old != value):
                raise abort(index, subindex, Abort.VALUE)

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        if index == 0x1003:
            for sub in self._history():
                self._core.data.put_number(0x1003, sub, 0)

    def reset(self, now_ns: int) -> None:
        self._active.clear()
        self._tell_active()
        self._waiting.clear()
        self._free_at_ns = 0
        self._core.data.put_number(0x1001, 0, 0)
        self._core.data.put_number(0x1003, 0, 0)

    def state_changed(self, now_ns: int) -> None:
        if not self._core.communicating:
            self._core.counters.emcys_dropped += len(self._waiting)
            self._waiting.clear()

    def tick(self, now_ns: int) -> None:
        while now_ns >= self.due_ns:
            self._transmit(self._waiting.popleft(), now_ns)

    @property
    def due_ns(self) -> int:
        """Return when the next message may be sent."""
        return self._free_at_ns if self._waiting and not self._core.mutes else NEVER

    def _tell_active(self) -> None:
        self.active = tuple(dict.fromkeys(code for code, _ in self._active))

    def _emit(self, message: bytes, now_ns: int) -> None:
        self._core.note(now_ns, "emcy", 0, 0, message)
        unheard = not self._core.communicating or self._core.mutes or not self._core.data.has(0x1014)
        if unheard or len(self._waiting) >= MAX_WAITING:
            self._core.counters.emcys_dropped += 1
            return
        self._waiting.append(message)
        self.tick(now_ns)

    def _transmit(self, message: bytes, now_ns: int) -> None:
        cob_id = self._core.data.number(0x1014)
        if cob_id & _INVALID:
            self._core.counters.emcys_dropped += 1
            return
        inhibit_ns = self._core.data.number(0x1015) * _UNIT_NS
        self._free_at_ns = now_ns + inhibit_ns
        self._core.counters.emcys += 1
        self._core.send(cob_id & 0x7FF, message, now_ns)

    def _update_register(self) -> int:
        bits = 0
        for register in self._active.values():
            bits |= register
        self._core.data.put_number(0x1001, 0, bits)
        return bits

    def _history(self) -> list[int]:
        found = self._core.data.dictionary.objects.get(0x1003)
        return sorted(sub for sub in found.entries if sub) if found else []

    def _remember(self, field: int) -> None:
        """Add an error to the history (1003h): the newest is at subindex 1, and the oldest is dropped."""
        data, subs = self._core.data, self._history()
        for sub in reversed(subs[1:]):
            data.put_number(0x1003, sub, data.number(0x1003, sub - 1))
        if subs:
            data.put_number(0x1003, subs[0], field)
            data.put_number(0x1003, 0, min(data.number(0x1003) + 1, len(subs)))
