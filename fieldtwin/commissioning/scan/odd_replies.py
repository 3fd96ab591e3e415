"""Replies of a scan that do not fit their requests, and their possible causes on a serial line and on TCP. The module
does no I/O.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fieldtwin.gateway.core.endpoint import SerialSettings
from fieldtwin.gateway.core.errors import ModbusExceptionReply


@dataclass(frozen=True, slots=True)
class OddReply:
    """A reply that does not fit its request, and the units (one or many) that sent it. `pdu` is empty if it was not a whole
    frame.
    """

    units: tuple[int, ...]
    settings: SerialSettings | None
    pdu: bytes

    @property
    def advice(self) -> str:
        """Return a description of the reply and its possible cause, which differs between a serial line and TCP."""
        if not self.pdu:
            if self.settings is not None:
                return "damaged each time: two devices with the same unit ID, or a bad line"
            return "not a Modbus frame: another protocol or framing at this port, or a faulty server"
        said = f"a reply that does not match the request ({self.pdu[:16].hex(' ').upper()})"
        if self.pdu[0] & 0x80 and len(self.pdu) == 2:
            code = self.pdu[1]
            name = ModbusExceptionReply.NAMES.get(code, "vendor specific")
            said += f": exception {code:02X}, {name}, for function {self.pdu[0] & 0x7F:02X}, which was not requested"
        if self.settings is not None:
            return f"{said}; two devices with the same unit ID, or a faulty device"
        return f"{said}; some servers answer this for unit IDs that they do not have"


def gathered(
    known: Sequence[OddReply], damaged: Mapping[int, bytes], settings: SerialSettings | None
) -> list[OddReply]:
    """Add the replies `damaged` (unit ID -> PDU), received at `settings`, to `known`, and return the result.

    The same reply from many units is one finding.
    """
    found = {(odd.settings, odd.pdu): set(odd.units) for odd in known}
    for unit, pdu in damaged.items():
        found.setdefault((settings, pdu), set()).add(unit)
    return [OddReply(tuple(sorted(units)), at, pdu) for (at, pdu), units in found.items()]
