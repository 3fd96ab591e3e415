"""The duration of a CAN frame on the bus, bit by bit (ISO 11898-1, 10.4 and 10.5); `can_fd_timing` has the rules of
CAN FD.

The functions depend on one frame only, not on the bus, the time or other frames.

A data frame with an 11-bit identifier and n bytes takes 47 + 8n bits unstuffed and at most 55 + 10n; with a 29-bit
identifier 67 + 8n to 80 + 10n. Both include the interframe space of 3 bits.

An error costs the bits sent before it, 6 to 12 bits of error flags, 8 of delimiter and the interframe space: 17 to 23
bits. An error-passive sender waits 8 more bits before it retries, 31 in all.
"""

from __future__ import annotations

from functools import lru_cache

from fieldtwin.emulators.wires.can_fd_timing import fd_bits
from fieldtwin.gateway.core.canframe import CanFrame

CRC15_POLYNOMIAL = 0x4599
"""The generator polynomial of the CRC, x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1, without its highest term."""

END_BITS = 10
"""The bits after the CRC, which are never stuffed: CRC delimiter, acknowledge slot and delimiter, and the 7 bits of end of
frame.
"""

INTERFRAME_BITS = 3
"""The bits of intermission after the end of a frame. Then every node may start to send."""

ERROR_FLAG_BITS, ERROR_DELIMITER_BITS = 6, 8
"""The parts of an error frame: flags of six equal bits that overlap to at most twelve bits, then eight recessive bits."""

_STUFF_AFTER = 5


def crc15(bits: str) -> int:
    """Return the CRC-15 of a string of ``0`` and ``1``: from start of frame to the last data bit, before stuffing."""
    crc = 0
    for bit in bits:
        feedback = (crc >> 14) ^ (bit == "1")
        crc = (crc << 1) & 0x7FFF
        if feedback:
            crc ^= CRC15_POLYNOMIAL
    return crc


def plain_bits(frame: CanFrame) -> str:
    """Return the bits from start of frame to the end of the CRC sequence, dominant ``0``, before stuffing."""
    rtr = "1" if frame.remote else "0"
    if frame.extended:
        base, extension = frame.can_id >> 18, frame.can_id & 0x3FFFF
        head = f"0{base:011b}11{extension:018b}{rtr}00"  # SOF, base, SRR, IDE, extension, RTR, r1, r0
    else:
        head = f"0{frame.can_id:011b}{rtr}00"  # SOF, identifier, RTR, IDE, r0
    data = "" if frame.remote else "".join(f"{byte:08b}" for byte in frame.data)
    covered = f"{head}{frame.dlc:04b}{data}"
    return f"{covered}{crc15(covered):015b}"


def stuff(bits: str) -> str:
    """Insert a complementary bit after every five equal bits. A stuff bit counts as a bit of the next run."""
    out = []
    run_of, run = "", 0
    for bit in bits:
        run = run + 1 if bit == run_of else 1
        run_of = bit
        out.append(bit)
        if run == _STUFF_AFTER:
            run_of, run = ("1" if bit == "0" else "0"), 1
            out.append(run_of)
    return "".join(out)


def bits_to_end(frame: CanFrame) -> int:
    """Return the bits from start of frame to the end of end-of-frame, when the frame is valid for receivers and sender."""
    if frame.fd:
        return len(fd_bits(frame)) + END_BITS
    return _stuffed_length(frame.can_id, frame.data, frame.extended, frame.remote, frame.dlc) + END_BITS


def bits_on_wire(frame: CanFrame) -> int:
    """Return the bits for which the frame keeps the bus busy: to the end of frame, and the interframe space."""
    return bits_to_end(frame) + INTERFRAME_BITS


@lru_cache(maxsize=4096)
def _stuffed_length(can_id: int, data: bytes, extended: bool, remote: bool, dlc: int) -> int:
    # Cached by content: process data repeats, and the length of a frame is needed when it wins and when it ends. It
    # uses tables by byte, because frames that do not repeat occur too: with strings of bits, `plain_bits` and `stuff`, a
    # frame takes 1.7 times as long.
    crc_of, stuffing = _tables()
    rtr = int(remote)
    if extended:
        head = (((can_id >> 18) << 2 | 0b11) << 18 | can_id & 0x3FFFF) << 3 | rtr << 2
        length = 35  # includes start of frame, a leading zero
    else:
        head, length = can_id << 3 | rtr << 2, 15
    covered, length = (head << 4 | dlc) << 8 * len(data) | int.from_bytes(data), length + 4 + 8 * len(data)
    crc = 0
    for byte in covered.to_bytes((length + 7) // 8):  # zeros before the start do not change the checksum
        crc = (crc << 8 & 0x7FFF) ^ crc_of[crc >> 7 ^ byte]
    bits, length = covered << 15 | crc, length + 15
    odd = length % 8
    state, more = 0, 0
    for bit in f"{bits >> length - odd:0{odd}b}" if odd else "":
        state, added = _STEP[state, bit]
        more += added
    for byte in (bits & (1 << length - odd) - 1).to_bytes(length // 8):
        state, added = stuffing[state][byte]
        more += added
    return length + more


def _steps() -> dict[tuple[int, str], tuple[int, int]]:
    """Return the transitions from (state, bit) to (state, stuff bits).

    A state is 0 before the first bit, and later ten times the level, plus the length of the run, plus one.
    """
    steps = {}
    for state in (0, *(10 * level + run + 1 for level in (0, 1) for run in range(1, _STUFF_AFTER))):
        for bit in "01":
            level, run = divmod(state - 1, 10) if state else (-1, 0)
            run = run + 1 if level == int(bit) else 1
            if run == _STUFF_AFTER:  # the complement is stuffed, and begins a run
                steps[state, bit] = 10 * (1 - int(bit)) + 1 + 1, 1
            else:
                steps[state, bit] = 10 * int(bit) + run + 1, 0
    return steps


_STEP = _steps()


@lru_cache(maxsize=1)
def _tables() -> tuple[list[int], dict[int, list[tuple[int, int]]]]:
    """Return the CRC of each byte, and the effect of each byte on each stuffing state. Computed on first use."""
    stuffing: dict[int, list[tuple[int, int]]] = {}
    for state in {state for state, _ in _STEP}:
        stuffing[state] = []
        for byte in range(256):
            now, total = state, 0
            for bit in f"{byte:08b}":
                now, added = _STEP[now, bit]
                total += added
            stuffing[state].append((now, total))
    return [crc15(f"{byte:08b}") for byte in range(256)], stuffing


def arbitration_key(frame: CanFrame) -> int:
    """Return the arbitration field as a number. Of two frames that start together, the frame with the lower number wins.

    For one base identifier, 11-bit data frames win over 11-bit remote frames, and these win over all 29-bit frames (whose SRR and
    IDE bits are recessive). Among 29-bit frames the extension decides, then data frames win over remote frames.
    """
    if frame.extended:
        base, extension = frame.can_id >> 18, frame.can_id & 0x3FFFF
        return base << 21 | 0b11 << 19 | extension << 1 | frame.remote
    return frame.can_id << 21 | frame.remote << 20


def wire_bits(frame: CanFrame) -> str:
    """Return all bits of an acknowledged frame from start to end of frame, stuffed up to the end of the CRC."""
    return (fd_bits(frame) if frame.fd else stuff(plain_bits(frame))) + "1" + "0" + "1" + "1" * 7


def last_errant_bit(frame: CanFrame) -> int:
    """Return the last bit whose error destroys the frame for all: the last but one of end of frame (ISO 11898-1, 10.4.2.6)."""
    return bits_to_end(frame) - 2


def crc_objection_bit(frame: CanFrame) -> int:
    """Return the bit at which a receiver that found the CRC wrong starts its error flag: after the acknowledge delimiter."""
    return bits_to_end(frame) - 7


def acknowledge_bit(frame: CanFrame) -> int:
    """Return the position of the acknowledge slot in the frame."""
    return bits_to_end(frame) - 9


def error_flag_bits(frame: CanFrame, seen: str) -> int:
    """Return the duration of dominant error flags in bits. The first flag begins after `seen`, the bits of `frame` up to there.

    The other nodes detect the error when the first flag's six dominant bits violate the stuffing or the fixed form, and
    reply with six bits of their own: 6 bits if all nodes detect it at once (the last bit of `seen` violated the
    stuffing), otherwise 7 to 12.
    """
    stuffed = bits_to_end(frame) - END_BITS
    tail = seen[-_STUFF_AFTER - 1 :]
    if len(seen) <= stuffed and len(tail) == _STUFF_AFTER + 1 and tail in ("0" * 6, "1" * 6):
        return ERROR_FLAG_BITS
    run = len(seen) - len(seen.rstrip("0"))
    for more in range(ERROR_FLAG_BITS):
        at = len(seen) + more
        stuffing_broken = at < stuffed and run + more + 1 > _STUFF_AFTER
        form_broken = at >= stuffed and at != stuffed + 1  # the acknowledge slot may be dominant
        if stuffing_broken or form_broken:
            return more + 1 + ERROR_FLAG_BITS
    return 2 * ERROR_FLAG_BITS
