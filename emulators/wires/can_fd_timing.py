"""The duration of a CAN FD frame on the bus, bit by bit (ISO 11898-1:2015, 10.4.2 and 10.5).

The functions depend on one frame only, like those of `can_timing` for classic frames. CAN FD differs in these points: a frame has
up to 64 bytes; the checksum follows a count of the stuff bits, and has stuff bits at fixed positions instead of after five equal
bits; with the bit-rate switch, the bits from ESI to the CRC delimiter are sent at the data bit rate.

The rates change at the sample points of the bits BRS and CRC delimiter. With the same sample point in both phases, that
takes exactly as long as a whole BRS bit at the nominal rate and a whole CRC delimiter at the data bit rate, which is
what this module counts.
"""

from __future__ import annotations

from functools import lru_cache

from fieldtwin.gateway.core.canframe import CanFrame

CRC17, CRC21 = (17, 0x1685B), (21, 0x102899)
"""The check sums of CAN FD: length in bits, and polynomial without its highest term. Frames with up to 16 bytes of data use
the first.
"""
_LENGTH_CODES = {12: 9, 16: 10, 20: 11, 24: 12, 32: 13, 48: 14, 64: 15}
_STUFF_AFTER, _FIXED_EVERY = 5, 4


def fd_bits(frame: CanFrame) -> str:
    """Return the bits from start of frame to the end of the CRC sequence, dominant ``0``, with all stuff bits."""
    return _bits(frame.can_id, frame.data, frame.extended, frame.brs, frame.esi)


def data_phase(frame: CanFrame) -> tuple[int, int]:
    """Return the first bit that is sent at the data bit rate, and the first bit after the data phase, from start of frame.

    Both are equal for a frame without the bit-rate switch.
    """
    if not frame.brs:
        return 0, 0
    head = _head(frame.can_id, frame.extended, frame.brs)
    return len(_stuff(head)[0]), len(fd_bits(frame)) + 1


def _head(can_id: int, extended: bool, brs: bool) -> str:
    """Return the bits from start of frame to BRS."""
    if extended:  # SOF, base, SRR, IDE, extension, RRS, FDF, res, BRS
        return f"0{can_id >> 18:011b}11{can_id & 0x3FFFF:018b}010{int(brs)}"
    return f"0{can_id:011b}0010{int(brs)}"  # SOF, identifier, RRS, IDE, FDF, res, BRS


@lru_cache(maxsize=1024)
def _bits(can_id: int, data: bytes, extended: bool, brs: bool, esi: bool) -> str:
    size = len(data)
    covered = f"{_head(can_id, extended, brs)}{int(esi)}{_LENGTH_CODES.get(size, size):04b}"
    covered += "".join(f"{byte:08b}" for byte in data)
    stuffed, count = _stuff(covered)
    count %= 8
    gray = count ^ count >> 1
    counted = f"{gray:03b}{gray.bit_count() % 2}"
    length, polynomial = CRC17 if size <= 16 else CRC21
    tail = f"{counted}{_crc(stuffed + counted, length, polynomial):0{length}b}"
    out = stuffed
    for at in range(0, len(tail), _FIXED_EVERY):  # a fixed stuff bit is the complement of the bit before it
        out += ("1" if out[-1] == "0" else "0") + tail[at : at + _FIXED_EVERY]
    return out


def _stuff(bits: str) -> tuple[str, int]:
    """Return `bits` with stuff bits, and the number of stuff bits.

    No stuff bit follows the last bit, because a fixed stuff bit follows it.
    """
    out: list[str] = []
    run_of, run, count = "", 0, 0
    for at, bit in enumerate(bits):
        run = run + 1 if bit == run_of else 1
        run_of = bit
        out.append(bit)
        if run == _STUFF_AFTER and at + 1 < len(bits):
            run_of, run = ("1" if bit == "0" else "0"), 1
            out.append(run_of)
            count += 1
    return "".join(out), count


def _crc(bits: str, length: int, polynomial: int) -> int:
    """Return the checksum of `bits`; its initial value has only the highest bit set (10.4.2.6)."""
    top, mask = length - 1, (1 << length) - 1
    crc = 1 << top
    for bit in bits:
        feedback = (crc >> top) ^ (bit == "1")
        crc = (crc << 1) & mask
        if feedback:
            crc ^= polynomial
    return crc
