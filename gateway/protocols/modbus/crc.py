"""The check sum of Modbus RTU (SL 6.2.2): CRC-16, polynomial A001h reflected, start FFFFh, sent low byte first."""

from __future__ import annotations


def _table() -> tuple[int, ...]:
    entries = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
        entries.append(crc)
    return tuple(entries)


_TABLE = _table()


def crc16(data: bytes | bytearray) -> int:
    """The check sum of `data`. Over a whole frame, its own two check bytes included, it is 0."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc


def with_crc(data: bytes) -> bytes:
    """`data` and its check sum, as on the wire."""
    return data + crc16(data).to_bytes(2, "little")
