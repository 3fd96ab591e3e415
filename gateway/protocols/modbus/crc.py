"""The check sum of Modbus RTU (SL 6.2.2): CRC-16, polynomial A001h reflected, start FFFFh, sent low byte first.

Two bytes at a time: a table of 65536 entries halves the time of what is the dearest part of an RTU exchange here.
"""

from __future__ import annotations

import struct
from functools import lru_cache

KEPT = 256
"""Frames whose check sums are kept."""


def _of_byte(byte: int) -> int:
    for _ in range(8):
        byte = (byte >> 1) ^ 0xA001 if byte & 1 else byte >> 1
    return byte


_BYTE = [_of_byte(byte) for byte in range(256)]

# The check sum is linear, so the entry of a word is that of its low byte, gone through twice, and of its high byte.
_LOW = [(entry >> 8) ^ _BYTE[entry & 0xFF] for entry in _BYTE]
_WORD = [high ^ low for high in _BYTE for low in _LOW]

_MOST_WORDS = 128  # those of the longest frame
_WORDS = [struct.Struct(f"<{count}H").unpack_from for count in range(_MOST_WORDS + 1)]


def crc16(data: bytes | bytearray) -> int:
    """The check sum of `data`. Over a whole frame, its own two check bytes included, it is 0."""
    count = len(data) >> 1
    words = _WORDS[count] if count <= _MOST_WORDS else struct.Struct(f"<{count}H").unpack_from
    crc = 0xFFFF
    for word in words(data):
        crc = _WORD[crc ^ word]
    return (crc >> 8) ^ _BYTE[(crc ^ data[-1]) & 0xFF] if len(data) & 1 else crc


@lru_cache(maxsize=KEPT)
def with_crc(data: bytes) -> bytes:
    """`data` and its check sum, as on the wire. Kept: the same is asked again and again, and values seldom change."""
    return data + crc16(data).to_bytes(2, "little")


@lru_cache(maxsize=KEPT)
def is_whole(frame: bytes) -> bool:
    """Whether a frame's check sum is right. Kept as `with_crc`'s."""
    return crc16(frame) == 0
