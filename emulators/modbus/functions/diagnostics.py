"""The counters of a unit, and the functions that read and clear them: 07, 08, 0B and 0Ch (AP 6.7 to 6.10; SL appendix A).

The same numbers are counted in two ways: `UnitCounters` only increase, because runs are checked against them; the counters
that a client reads start again when the client clears them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from fieldtwin.emulators.modbus.bank import IllegalFunction, IllegalValue
from fieldtwin.emulators.modbus.functions.event_log import ENTERED_LISTEN_ONLY, RESTARTED, CommEventLog

RETURN_QUERY_DATA = 0x00
RESTART = 0x01
DIAGNOSTIC_REGISTER = 0x02
CHANGE_DELIMITER = 0x03
LISTEN_ONLY = 0x04
CLEAR_COUNTERS = 0x0A
CLEAR_OVERRUN = 0x14


@dataclass(slots=True)
class UnitCounters:
    """Counters since the unit was created.

    `bus_*` count all frames on the unit's serial line, the other counters those for this unit.
    """

    bus_messages: int = 0
    """Complete frames on the line, whatever their unit ID (CPT1)."""
    bus_errors: int = 0
    """Damaged frames on the line (CPT2)."""
    requests: int = 0
    """Requests addressed to this unit, broadcasts not included."""
    replies: int = 0
    """Replies sent, exceptions included."""
    exceptions: int = 0
    """Exception responses sent (CPT3)."""
    broadcasts: int = 0
    """Requests addressed to unit 0 of a serial line."""
    busy: int = 0
    """Exception responses with code 06 (CPT7)."""
    unanswered: int = 0
    """Requests received and not answered: broadcasts, and all requests in listen-only mode (CPT5)."""
    completed: int = 0
    """Requests executed without an exception, broadcasts included, except those that fetch events (AP 6.9)."""
    naks: int = 0
    """Exception responses with code 07 (CPT6)."""
    overruns: int = 0
    """Messages that arrived faster than the unit could take them (CPT8). In an emulator, only a fault causes such a message."""

    @property
    def messages(self) -> int:
        """Return the number of messages addressed to this unit (CPT4)."""
        return self.requests + self.broadcasts


_READABLE = {
    0x0B: "bus_messages",
    0x0C: "bus_errors",
    0x0D: "exceptions",
    0x0E: "messages",
    0x0F: "unanswered",
    0x10: "naks",
    0x11: "busy",
    0x12: "overruns",
}
_RESTARTS = (b"\x08\x00\x01\x00\x00", b"\x08\x00\x01\xff\x00")
_UNCOUNTED = (0x0B, 0x0C)
_DIAGNOSTICS, _CLEARING = 0x08, (b"\x08\x00\x01", b"\x08\x00\x0a")
_LINE_FEED = 0x0A
_FRAME_CHARACTERS = frozenset(b":0123456789ABCDEFabcdef\r")
"""Characters that can occur inside an ASCII frame, and therefore cannot end one."""


class UnitDiagnostics:
    """Functions 07, 08, 0B and 0C of one unit.

    `status` holds the eight outputs of function 07, `register` the value that 08/02 reads; the device sets both.
    `delimiter` is the character that ends ASCII frames instead of LF after a request 08/03.
    """

    def __init__(self, counters: UnitCounters) -> None:
        self.counters = counters
        self.log = CommEventLog()
        self.listen_only = False
        self.status = 0
        self.register = 0
        self.delimiter = _LINE_FEED
        self._cleared = UnitCounters()

    def clear(self) -> None:
        """Restart the client's counters at zero; the unit's own counters keep their values."""
        self._cleared = replace(self.counters)

    def wakes(self, pdu: bytes) -> bool:
        """End listen-only mode if `pdu` is 08/01, the only request that does this. Return whether it is.

        The unit does not answer this request.
        """
        if pdu not in _RESTARTS:
            return False
        self._restart(pdu)
        return True

    def completed(self, pdu: bytes) -> None:
        """Count a request that was executed."""
        if pdu[0] not in _UNCOUNTED and not (pdu[0] == _DIAGNOSTICS and pdu[:3] in _CLEARING):
            self.counters.completed += 1

    def respond(self, pdu: bytes) -> bytes | None:
        """Return the answer to an 08h request, or None if the standard requires silence. Raises `Refusal`."""
        if len(pdu) < 3:
            raise IllegalValue("diagnostic request without a sub-function")
        sub = int.from_bytes(pdu[1:3], "big")
        if sub == RETURN_QUERY_DATA:
            return pdu
        if sub not in _READABLE and sub not in (
            RESTART,
            DIAGNOSTIC_REGISTER,
            CHANGE_DELIMITER,
            LISTEN_ONLY,
            CLEAR_COUNTERS,
            CLEAR_OVERRUN,
        ):
            raise IllegalFunction(f"diagnostic sub-function {sub:04X}h")
        if sub == CHANGE_DELIMITER:
            return self._change_delimiter(pdu)
        if pdu[3:] != b"\x00\x00" and pdu not in _RESTARTS:
            raise IllegalValue("diagnostic data field", expected="0000h", got=pdu[3:].hex())
        return self._execute(sub, pdu)

    def exception_status(self, pdu: bytes) -> bytes:
        """Return the answer to function 07."""
        _require_bare(pdu)
        return bytes((pdu[0], self.status & 0xFF))

    def event_counter(self, pdu: bytes, processing: bool) -> bytes:
        """Return the answer to function 0B. `processing` says that an earlier program command is still being executed."""
        _require_bare(pdu)
        return pdu[:1] + self._status_and_count(processing)

    def event_log(self, pdu: bytes, processing: bool) -> bytes:
        """Return the answer to function 0C."""
        _require_bare(pdu)
        data = self._status_and_count(processing) + _word(self._since_clear("bus_messages")) + self.log.content
        return bytes((pdu[0], len(data))) + data

    def _execute(self, sub: int, pdu: bytes) -> bytes | None:
        if sub == RESTART:
            self._restart(pdu)
            return pdu
        if sub == CLEAR_COUNTERS:
            self.clear()
            self.register = 0
            return pdu
        if sub == LISTEN_ONLY:
            self.listen_only = True
            self.log.note(ENTERED_LISTEN_ONLY)
            return None
        if sub == CLEAR_OVERRUN:
            self._cleared.overruns = self.counters.overruns
            return pdu
        return pdu[:3] + _word(self.register if sub == DIAGNOSTIC_REGISTER else self._since_clear(_READABLE[sub]))

    def _restart(self, pdu: bytes) -> None:
        self.listen_only = False
        self.clear()
        if pdu[3] == 0xFF:
            self.log.clear()
        self.log.note(RESTARTED)

    def _change_delimiter(self, pdu: bytes) -> bytes:
        if len(pdu) != 5 or pdu[4] or pdu[3] > 0x7F or pdu[3] in _FRAME_CHARACTERS:
            raise IllegalValue("delimiter", expected="a character and 00h", got=pdu[3:].hex())
        self.delimiter = pdu[3]
        return pdu

    def _status_and_count(self, processing: bool) -> bytes:
        return (b"\xff\xff" if processing else b"\x00\x00") + _word(self._since_clear("completed"))

    def _since_clear(self, name: str) -> int:
        return int(getattr(self.counters, name)) - int(getattr(self._cleared, name))


def _require_bare(pdu: bytes) -> None:
    if len(pdu) != 1:
        raise IllegalValue("length of the request", expected="1 byte", got=str(len(pdu)))


def _word(value: int) -> bytes:
    return (value & 0xFFFF).to_bytes(2, "big")
