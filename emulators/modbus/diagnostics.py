"""What a unit counts, and function 08h that reads and clears it (AP 6.8; SL appendix A, CPT1 to CPT8).

Two views of one set of numbers: `UnitCounters` only grow (they are evidence), a master's view starts at its last clear.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from emulators.modbus.bank import IllegalFunction, IllegalValue

RETURN_QUERY_DATA = 0x00
RESTART = 0x01
DIAGNOSTIC_REGISTER = 0x02
LISTEN_ONLY = 0x04
CLEAR_COUNTERS = 0x0A
CLEAR_OVERRUN = 0x14


@dataclass(slots=True)
class UnitCounters:
    """Everything since the unit was made. `bus_*` count the line it hangs on, the rest what concerns this unit."""

    bus_messages: int = 0
    """Whole frames heard on the line, for whomever (CPT1)."""
    bus_errors: int = 0
    """Damaged frames heard on the line (CPT2)."""
    requests: int = 0
    """Addressed to this unit, broadcasts not included."""
    replies: int = 0
    """Sent, exceptions included."""
    exceptions: int = 0
    """Exception responses sent (CPT3)."""
    broadcasts: int = 0
    """Addressed to unit 0 of a serial line."""
    busy: int = 0
    """Exception responses with code 06 (CPT7)."""
    unanswered: int = 0
    """Heard and not answered: broadcasts, listen-only (CPT5)."""

    @property
    def messages(self) -> int:
        """Messages that were for this unit (CPT4)."""
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
_ALWAYS_ZERO = frozenset({"naks", "overruns"})
"""No emulated unit answers NAK (it never programs itself), and nothing between us and the buffer can overrun."""


class Diagnostics:
    """Function 08h of one unit."""

    def __init__(self, counters: UnitCounters) -> None:
        self.counters = counters
        self.listen_only = False
        self._cleared = UnitCounters()

    def clear(self) -> None:
        """The master's counters start again at zero; the unit's own do not."""
        self._cleared = replace(self.counters)

    def wakes(self, pdu: bytes) -> bool:
        """Whether `pdu` is the one request that ends listen-only mode: 08/01. It does so, and is not answered."""
        if pdu not in (b"\x08\x00\x01\x00\x00", b"\x08\x00\x01\xff\x00"):
            return False
        self.listen_only = False
        self.clear()
        return True

    def respond(self, pdu: bytes) -> bytes | None:
        """The answer to an 08h request, None where the standard wants none. Raises `Refusal`."""
        if len(pdu) < 3:
            raise IllegalValue("diagnostic request without a sub-function")
        sub = int.from_bytes(pdu[1:3], "big")
        if sub == RETURN_QUERY_DATA:
            return pdu
        if sub not in _READABLE and sub not in (
            RESTART,
            DIAGNOSTIC_REGISTER,
            LISTEN_ONLY,
            CLEAR_COUNTERS,
            CLEAR_OVERRUN,
        ):
            raise IllegalFunction(f"diagnostic sub-function {sub:04X}h")
        if pdu[3:] != b"\x00\x00" and not (sub == RESTART and pdu[3:] == b"\xff\x00"):
            raise IllegalValue("diagnostic data field", expected="0000h", got=pdu[3:].hex())
        return self._execute(sub, pdu)

    def _execute(self, sub: int, pdu: bytes) -> bytes | None:
        if sub in (RESTART, CLEAR_COUNTERS):
            self.clear()
            return pdu
        if sub == LISTEN_ONLY:
            self.listen_only = True
            return None
        if sub == CLEAR_OVERRUN:
            return pdu
        value = 0 if sub == DIAGNOSTIC_REGISTER else self._since_clear(_READABLE[sub])
        return pdu[:3] + (value & 0xFFFF).to_bytes(2, "big")

    def _since_clear(self, name: str) -> int:
        if name in _ALWAYS_ZERO:
            return 0
        return int(getattr(self.counters, name)) - int(getattr(self._cleared, name))
