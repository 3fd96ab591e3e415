"""What the tests of decoding and reports share: traces of the observatory, written by hand."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

from fieldtwin.scenarios.trace import Event, Kind
from gateway.protocols.modbus.crc import with_crc
from twin.system import System, load_system

MS = 1_000_000


@cache
def observatory() -> System:
    return load_system("observatory")


def chunk(t_ms: float, sent: bool, data: bytes | str, bus: str = "line1") -> Event:
    raw = bytes.fromhex(data) if isinstance(data, str) else data
    return Event(int(t_ms * MS), Kind.FRAME, bus, {"dir": "sent" if sent else "received", "bytes": raw.hex()})


def ask(t_ms: float, pdu: str, unit: int = 1) -> Event:
    """A request of the gateway's on the serial line."""
    return chunk(t_ms, True, with_crc(bytes([unit]) + bytes.fromhex(pdu)))


def answer(t_ms: float, pdu: str | bytes, unit: int = 1) -> Event:
    raw = bytes.fromhex(pdu) if isinstance(pdu, str) else pdu
    return chunk(t_ms, False, with_crc(bytes([unit]) + raw))


def adu(transaction: int, pdu: str, unit: int = 1) -> bytes:
    raw = bytes.fromhex(pdu)
    return struct.pack(">HHHB", transaction, 0, len(raw) + 1, unit) + raw


def can(t_ms: float, text: str, **flags: Any) -> Event:
    """``605#40 18 10 04`` as on a bus; the gateway sends what a master sends."""
    number, _, data = text.partition("#")
    can_id, sent = int(number, 16), number in ("000", "080") or number.startswith(("20", "60")) or number == "7E5"
    fields = {"dir": "sent" if sent else "received", "id": can_id, "bytes": bytes.fromhex(data).hex(), **flags}
    return Event(int(t_ms * MS), Kind.FRAME, "can0", fields)


def note(t_ms: float, kind: Kind, where: str, **data: Any) -> Event:
    return Event(int(t_ms * MS), kind, where, data)


CTD_VALUES = b"\x04\x14" + struct.pack(">fffII", 12.5, 4.25, 3.5, 7, 70_000)
"""A reply to `READ_CTD`: pressure, temperature, conductivity, sample_count, instrument_time."""
READ_CTD = "04 0000 000A"
