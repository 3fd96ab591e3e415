"""Parse emergency messages (CiA 301, 7.2.7), by which a node reports its errors. `emcy_log` keeps their history."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.errors import Desync

_CLASSES = {
    0x00: "error reset or no error",
    0x10: "generic error",
    0x20: "current",
    0x21: "current, CANopen device input side",
    0x22: "current inside the CANopen device",
    0x23: "current, CANopen device output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the CANopen device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "CANopen device temperature",
    0x50: "CANopen device hardware",
    0x60: "CANopen device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol error",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "CANopen device specific",
}
_CODES = {
    0x8110: "CAN overrun (objects lost)",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard error or heartbeat error",
    0x8140: "recovered from bus off",
    0x8150: "CAN-ID collision",
    0x8210: "PDO not processed due to length error",
    0x8220: "PDO length exceeded",
    0x8230: "DAM MPDO not processed, destination object not available",
    0x8240: "unexpected SYNC data length",
    0x8250: "RPDO time-out",
}


@dataclass(frozen=True, slots=True)
class Emcy:
    """An emergency message. `code` 0000h means that an error is gone. `vendor` is up to 5 manufacturer bytes.

    `register` is the error register (1001h), or None if the message was too short to carry it; `length` is the number
    of bytes received (8 by the standard).
    """

    code: int
    register: int | None
    vendor: bytes
    length: int

    @property
    def is_reset(self) -> bool:
        return self.code >> 8 == 0

    @property
    def meaning(self) -> str:
        """Return the standard's text for the code, or for its class (tables 26 and following of 7.2.7.1)."""
        by_class = _CLASSES.get(self.code >> 8) or _CLASSES.get(self.code >> 8 & 0xF0, "unknown")
        return _CODES.get(self.code, by_class)


def parse_emcy(data: bytes) -> Emcy:
    """Read the data of an EMCY frame; 2 to 7 bytes are tolerated (CO-053). Raises `Desync` if it is too short for a
    code.

    An empty frame must not be taken for code 0000h, which would clear an error.
    """
    if len(data) < 2:
        raise Desync("an emergency message without a code", expected="8 bytes", got=f"{len(data)}")
    register = data[2] if len(data) > 2 else None
    return Emcy(int.from_bytes(data[:2], "little"), register, bytes(data[3:8]), len(data))
