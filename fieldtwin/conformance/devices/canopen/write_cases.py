"""Cases of SDO downloads: to objects that the node must not accept, and to objects that the user named for writing, whose
values are restored.

Clauses are CiA 301's.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fieldtwin.conformance.core.case import Finding, Impact
from fieldtwin.conformance.devices.canopen.checks import aborted, must_abort, present, verdict
from fieldtwin.conformance.devices.canopen.connection import ERROR_CONTROL, Key, NodeConnection, SdoReply, mux, shown
from fieldtwin.conformance.devices.device_case import NotHere, Unsaid
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType
from fieldtwin.gateway.protocols.canopen.sdo.block import crc16

UNKNOWN, CRC, READ_ONLY = 0x0504_0001, 0x0504_0004, 0x0601_0002
# CiA 301, 7.2.4.3.17 has a general code in addition to each pair, and does not state which of them a server must choose.
WRONG_LENGTH, WRONG_VALUE = 0x0607_0010, 0x0609_0030
TOO_LONG, TOO_SHORT = (0x0607_0012, WRONG_LENGTH), (0x0607_0013, WRONG_LENGTH)
TOO_HIGH, TOO_LOW = (0x0609_0031, WRONG_VALUE), (0x0609_0032, WRONG_VALUE)
SIGNED = frozenset({DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32})
ANY_LENGTH = frozenset({DataType.VISIBLE_STRING, DataType.OCTET_STRING, DataType.UNICODE_STRING, DataType.DOMAIN})


@asynccontextmanager
async def _borrowed(wire: NodeConnection, key: Key) -> AsyncIterator[bytes]:
    """Yield the object's value, and restore it afterwards. Raises `Unsaid` if it cannot be restored."""
    before = await present(wire, key)
    try:
        yield before
    finally:
        if await wire.upload(key) != before:
            wire.impact = max(wire.impact, Impact.WRITE, key=lambda impact: impact.rank)
            await wire.download(key, before)
            now = await wire.upload(key)
            if now != before:
                said = now.hex() if isinstance(now, bytes) else now
                raise Unsaid(f"{shown(key)} could not be restored: {said} instead of {before.hex()}")


async def _unchanged(wire: NodeConnection, key: Key, before: bytes, wrong: str) -> Finding:
    if wrong:
        await wire.abandon(key)  # ends any transfer in progress
    now = await wire.upload(key)
    if now != before:
        said = now.hex(" ").upper() if isinstance(now, bytes) else str(now)
        wrong = f"{shown(key)} is {said} instead of {before.hex(' ').upper()}" + (f"; {wrong}" if wrong else "")
    return await verdict(wire, wrong)


async def _number(wire: NodeConnection) -> tuple[Key, bytes]:
    """Return the first of the objects to write that is a number of 1, 2 or 4 bytes, with its value; 1017h only if there is
    no other.

    Raises `NotHere`, with the reason for each of these objects.
    """
    why_not = []
    for key in sorted(wire.may_write, key=lambda key: key == (0x1017, 0)):
        entry = wire.dictionary.get(*key) if wire.dictionary is not None else None
        if entry is not None and entry.type_code in ANY_LENGTH:
            why_not.append(f"{shown(key)} is text or a domain in the EDS")
            continue
        value = await wire.upload(key)
        if isinstance(value, bytes) and len(value) in (1, 2, 4):
            return key, value
        why_not.append(_instead(key, value))
    raise NotHere(f"needs an object of 1, 2 or 4 bytes by --write: {', '.join(why_not)}")


async def _text(wire: NodeConnection) -> tuple[Key, bytes]:
    """Return the first of the objects to write that has more than 14 bytes (three segments), with its value.

    Raises `NotHere`, with the reason for each of these objects.
    """
    why_not = []
    for key in wire.may_write:
        value = await wire.upload(key)
        if isinstance(value, bytes) and len(value) > 14:
            return key, value
        why_not.append(_instead(key, value))
    raise NotHere(f"needs an object of more than 14 bytes by --write: {', '.join(why_not)}")


def _instead(key: Key, value: bytes | SdoReply) -> str:
    """Return the reason why a case cannot use an object that the user named for writing."""
    if isinstance(value, SdoReply):
        return f"{shown(key)} could not be read ({value})"
    return f"{shown(key)} holds {len(value)} byte{'s' * (len(value) != 1)}"


# -- refusals ---------------------------------------------------------------------------------------------------------


async def read_only_expedited(wire: NodeConnection) -> Finding:
    """CO-006: write to the read-only object 1000h its own value."""
    return await must_abort(wire, b"\x23" + mux(0x1000) + wire.device_type.ljust(4, b"\0"), READ_ONLY)


async def read_only_segmented(wire: NodeConnection) -> Finding:
    """CO-006: download in segments to 1000h. The node must refuse the initiate, before any data."""
    return await must_abort(wire, b"\x21" + mux(0x1000) + b"\x14\0\0\0", READ_ONLY)


async def segment_alone(wire: NodeConnection) -> Finding:
    """CO-003: send a download segment without an initiate."""
    return await must_abort(wire, b"\x00abcdefg", UNKNOWN)


async def history_set(wire: NodeConnection) -> Finding:
    """CO-011: write a value other than 0 to 1003h:00, which can only be cleared."""
    if isinstance(there := await wire.upload((0x1003, 0)), SdoReply):
        raise NotHere(f"it has no error history, 1003h: {there}")
    return await must_abort(wire, b"\x2f" + mux(0x1003) + b"\x01", 0x0609_0030, 0x0800_0000)


async def store_signature(wire: NodeConnection) -> Finding:
    """CO-031: write an invalid signature to 1010h."""
    if isinstance(there := await wire.upload((0x1010, 1)), SdoReply):
        raise NotHere(f"it stores no parameters, 1010h: {there}")
    return await must_abort(wire, b"\x23" + mux(0x1010, 1) + b"none", 0x0800_0020, 0x0800_0022)


# -- lengths and limits -----------------------------------------------------------------------------------------------


async def too_long(wire: NodeConnection) -> Finding:
    """CO-009: download one byte more than the object has. The node may refuse the announced size, or the complete data."""
    key, before = await _number(wire)
    more = before + b"\0"
    async with _borrowed(wire, key):
        reply = await wire.ask(b"\x21" + mux(*key) + len(more).to_bytes(4, "little"))
        if reply.specifier == 3:
            reply = await wire.ask(bytes(((7 - len(more)) << 1 | 1,)) + more)
        return await _unchanged(wire, key, before, aborted(reply, *TOO_LONG))


async def too_short(wire: NodeConnection) -> Finding:
    """CO-009: download one byte less than the object has, in an expedited transfer."""
    key, before = await _number(wire)
    if len(before) < 2:
        raise NotHere(f"{shown(key)} has one byte")
    async with _borrowed(wire, key):
        return await _unchanged(wire, key, before, aborted(await wire.download(key, before[:-1]), *TOO_SHORT))


async def _limit(wire: NodeConnection, *, above: bool) -> Finding:
    for key in wire.may_write:
        entry = wire.dictionary.get(*key) if wire.dictionary is not None else None
        bound = None if entry is None else entry.high if above else entry.low
        if not isinstance(bound, int):
            # the object has no limit, or a limit of a real type, for which the next value depends on the precision
            continue
        async with _borrowed(wire, key) as before:
            value, bits = (bound + 1 if above else bound - 1), 8 * len(before)
            least = -(1 << bits - 1) if entry is not None and entry.type_code in SIGNED else 0
            if not least <= value < least + (1 << bits):  # no value exists beyond it
                continue
            reply = await wire.download(key, (value % (1 << bits)).to_bytes(len(before), "little"))
            return await _unchanged(wire, key, before, aborted(reply, *(TOO_HIGH if above else TOO_LOW)))
    raise NotHere("no object of --write has such a limit in the EDS, with values of its type outside it")


async def above_limit(wire: NodeConnection) -> Finding:
    """CO-010: download a value one above the upper limit in the EDS."""
    return await _limit(wire, above=True)


async def below_limit(wire: NodeConnection) -> Finding:
    """CO-010: download a value one below the lower limit in the EDS."""
    return await _limit(wire, above=False)


async def _announced(wire: NodeConnection, more: int, codes: tuple[int, ...]) -> Finding:
    key, before = await _number(wire)
    sent = len(before) + more
    if not sent:
        raise NotHere(f"{shown(key)} has one byte")
    async with _borrowed(wire, key):
        reply = await wire.ask(b"\x21" + mux(*key) + len(before).to_bytes(4, "little"))
        if reply.specifier != 3:
            raise NotHere(f"{shown(key)} takes no download in segments: {reply}")
        reply = await wire.ask(bytes(((7 - sent) << 1 | 1,)) + before[:sent].ljust(sent, b"\0"))
        return await _unchanged(wire, key, before, aborted(reply, *codes))


async def more_than_announced(wire: NodeConnection) -> Finding:
    """CO-013: download a byte more than was announced."""
    return await _announced(wire, 1, TOO_LONG)


async def less_than_announced(wire: NodeConnection) -> Finding:
    """CO-013: download a byte less than was announced."""
    return await _announced(wire, -1, TOO_SHORT)


async def without_size(wire: NodeConnection) -> Finding:
    """CO-029: download in an expedited transfer without the size bit: the object's own length applies."""
    key, before = await _number(wire)
    async with _borrowed(wire, key):
        reply = await wire.ask(b"\x22" + mux(*key) + before)
        return await _unchanged(wire, key, before, "" if reply.specifier == 3 else f"{reply} instead of taking it")


async def toggle_repeated(wire: NodeConnection) -> Finding:
    """CO-001: send the second segment of a download with the same toggle bit as the first."""
    key, before = await _text(wire)
    async with _borrowed(wire, key):
        reply = await wire.ask(b"\x21" + mux(*key) + len(before).to_bytes(4, "little"))
        if reply.specifier != 3:
            raise NotHere(f"{shown(key)} takes no download in segments: {reply}")
        await wire.ask(b"\x00" + before[:7])
        return await _unchanged(wire, key, before, aborted(await wire.ask(b"\x00" + before[7:14]), 0x0503_0000))


# -- block download (7.2.4.3.9 to 11) ----------------------------------------------------------------------------------


async def _begin_block(wire: NodeConnection, key: Key, size: int) -> SdoReply:
    reply = await wire.ask(b"\xc6" + mux(*key) + size.to_bytes(4, "little"))
    if reply.specifier != 5 or not 1 <= reply.data[4] <= 127:
        raise NotHere(f"it has no block download: {reply}")
    return reply


def _segments(value: bytes) -> list[bytes]:
    """Return all segments of a value that fits into one sub-block."""
    pieces = [value[at : at + 7] for at in range(0, len(value), 7)]
    last = len(pieces)
    return [bytes((n | (0x80 if n == last else 0),)) + piece.ljust(7, b"\0") for n, piece in enumerate(pieces, 1)]


def _end(value: bytes, crc: int) -> bytes:
    unused = -len(value) % 7
    return (bytes((0xC1 | unused << 2,)) + crc.to_bytes(2, "little")).ljust(8, b"\0")


async def crc_mismatch(wire: NodeConnection) -> Finding:
    """CO-015: end a block download with a wrong CRC."""
    key, before = await _number(wire)
    async with _borrowed(wire, key):
        begun = await _begin_block(wire, key, len(before))
        if not begun.data[0] & 4:
            await wire.abandon(key)
            raise NotHere("its block download has no CRC")
        reply = await wire.ask(_segments(before)[0])
        if reply.data[:2] != b"\xa2\x01":
            return await _unchanged(wire, key, before, f"{reply} instead of an acknowledgement")
        return await _unchanged(wire, key, before, aborted(await wire.ask(_end(before, crc16(before) ^ 0xFFFF)), CRC))


async def _whole_block(wire: NodeConnection, *, lose: bool) -> Finding:
    """Download the object's present value by blocks. With `lose`, the second segment is omitted, and sent only after the
    reply.
    """
    key, before = await _text(wire)
    async with _borrowed(wire, key):
        begun = await _begin_block(wire, key, len(before))
        segments = _segments(before)
        if len(segments) > begun.data[4]:
            await wire.abandon(key)
            raise NotHere(f"its sub-blocks are of {begun.data[4]} segments: shorter than {shown(key)}")
        wire.forget()
        for n, segment in enumerate(segments):
            if not (lose and n == 1):
                await wire.send_sdo(segment)
        reply = await wire.reply()
        if lose:
            if reply.data[:2] != b"\xa2\x01":
                return await _unchanged(
                    wire, key, before, f"{reply} instead of an acknowledgement of the first segment"
                )
            wire.forget()
            for n, segment in enumerate(_segments(before[7:])):
                await wire.send_sdo(bytes((segment[0],)) + segment[1:] if n else segment)
            reply = await wire.reply()
            segments = segments[1:]
        if reply.data[:2] != bytes((0xA2, len(segments))):
            return await _unchanged(
                wire, key, before, f"{reply} instead of an acknowledgement of {len(segments)} segments"
            )
        if more := (await wire.reply(min(0.1, wire.timeout_s))).data:
            return await _unchanged(wire, key, before, f"a second reply to a sub-block: {more.hex(' ').upper()}")
        end = await wire.ask(_end(before, crc16(before)))
        return await _unchanged(wire, key, before, "" if end.specifier == 5 else f"{end} instead of the end")


async def one_reply_a_block(wire: NodeConnection) -> Finding:
    """CO-020: download in blocks. The node must acknowledge each sub-block exactly once."""
    return await _whole_block(wire, lose=False)


async def segment_lost(wire: NodeConnection) -> Finding:
    """CO-017: omit a segment of the last sub-block; then send it and the following ones, numbered from 1."""
    return await _whole_block(wire, lose=True)


# -- heartbeat ----------------------------------------------------------------------------------------------------------

PERIOD_MS = 200
BEATS = 4


async def heartbeat_changed(wire: NodeConnection) -> Finding:
    """CO-041: change 1017h. The new heartbeat period must apply at once."""
    key = (0x1017, 0)
    if key not in wire.may_write:
        raise NotHere("changes the heartbeat: --write 1017:00")
    async with _borrowed(wire, key):
        reply = await wire.download(key, PERIOD_MS.to_bytes(2, "little"))
        if reply.specifier != 3:
            raise NotHere(f"1017h cannot be written: {reply}")
        frames = await wire.listen(PERIOD_MS * (BEATS + 0.5) / 1000)
        beats = sum(frame.can_id == ERROR_CONTROL + wire.node and len(frame.data) == 1 for frame in frames)
        wrong = (
            ""
            if BEATS - 1 <= beats <= BEATS + 1
            else f"{beats} heartbeats in {BEATS + 0.5:g} periods of {PERIOD_MS} ms"
        )
    return await verdict(wire, wrong)
