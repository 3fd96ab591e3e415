"""Cases of SDO uploads, ordinary and in blocks: nothing is written. Clauses are CiA 301's."""

from __future__ import annotations

from fieldtwin.conformance.core.case import Finding, failed, passed
from fieldtwin.conformance.devices.canopen.checks import (
    aborted,
    begin_upload,
    lacks,
    long_object,
    must_abort,
    present,
    verdict,
)
from fieldtwin.conformance.devices.canopen.connection import SDO_REQUEST, Key, NodeConnection, SdoReply, mux, shown
from fieldtwin.conformance.devices.device_case import NotHere, Unsaid
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.protocols.canopen.sdo.block import crc16

TOGGLE, UNKNOWN, BLOCK_SIZE = 0x0503_0000, 0x0504_0001, 0x0504_0002
UNLIKELY = (0x5FFE, 0x5F0D, 0x2FFD, 0x1FFE)
"""Indices of objects that very few devices have."""
MOST_BLOCKS = 200
COUNTED = (0x1018, 0x1010, 0x1016, 0x1029)
"""Records and arrays whose sub 00 states their number of subindices."""


async def toggle_repeated(wire: NodeConnection) -> Finding:
    """CO-001: repeat the toggle bit in the second segment. The node must abort, and must not continue the transfer afterwards."""
    await begin_upload(wire, await long_object(wire))
    await wire.ask(b"\x60")
    repeated = await wire.ask(b"\x60")
    if wrong := aborted(repeated, TOGGLE):
        return failed(f"for the repeated toggle: {wrong}")
    following = await wire.ask(b"\x70")
    if wrong := aborted(following, UNKNOWN):
        return await verdict(wire, f"for the repeated toggle: {repeated}; for the next segment: {wrong}")
    return await verdict(wire, "", f"for the repeated toggle: {repeated}; for the next segment: {following}")


async def client_aborts(wire: NodeConnection) -> Finding:
    """CO-002: abort after a segment, and then request the next segment nevertheless."""
    key = await long_object(wire)
    await begin_upload(wire, key)
    await wire.ask(b"\x60")
    wire.forget()
    await wire.abandon(key)
    reply = await wire.reply()
    if reply.data:
        return failed(f"answers the abort: {reply}")
    return await verdict(wire, aborted(await wire.ask(b"\x70"), UNKNOWN))


async def segment_alone(wire: NodeConnection) -> Finding:
    """CO-003: request an upload segment without an initiate."""
    return await must_abort(wire, b"\x60", UNKNOWN)


async def unknown_specifier(wire: NodeConnection) -> Finding:
    """CO-004: send a request with command specifier 7, which is not defined."""
    return await must_abort(wire, b"\xe0", UNKNOWN)


async def begun_anew(wire: NodeConnection) -> Finding:
    """CO-005: begin a second upload in the middle of one.

    The server may serve the new upload at once, or abort it and serve the next one: CiA 301 describes neither, and the
    interrupted transfer is over in both cases.
    """
    await begin_upload(wire, await long_object(wire))
    await wire.ask(b"\x60")
    found = await wire.upload((0x1000, 0))
    if isinstance(found, SdoReply) and found.abort:
        return await verdict(wire, "", f"{found}, then normal service")
    if found != wire.device_type:
        said = str(found) if isinstance(found, SdoReply) else found.hex(" ").upper()
        return failed(f"{said} instead of 1000h")
    return await verdict(wire, "")


async def write_only(wire: NodeConnection) -> Finding:
    """CO-007: upload an object that is write-only according to the EDS."""
    entries = [e for e in wire.dictionary or () if not e.readable]
    if not entries:
        raise NotHere("the EDS has no write-only object")
    return await must_abort(wire, b"\x40" + mux(entries[0].index, entries[0].subindex), 0x0601_0001)


async def missing_index(wire: NodeConnection) -> Finding:
    """CO-008: upload an object whose index does not exist."""
    for index in UNLIKELY:
        if wire.dictionary is not None and wire.dictionary.get(index) is not None:
            continue
        reply = await wire.ask(b"\x40" + mux(index))
        if reply.data and not reply.abort:
            await wire.abandon((index, 0))
            continue
        return await verdict(wire, aborted(reply, 0x0602_0000))
    raise Unsaid("it has all objects of " + ", ".join(f"{index:04X}h" for index in UNLIKELY))


async def subindex_of_a_var(wire: NodeConnection) -> Finding:
    """CO-008: upload subindex 01 of 1000h, which does not exist because 1000h is a VAR."""
    return await must_abort(wire, b"\x40" + mux(0x1000, 1), 0x0609_0011)


async def subindex_beyond(wire: NodeConnection) -> Finding:
    """CO-008: upload one subindex beyond the number in sub 00."""
    for index in COUNTED:
        count = await wire.upload((index, 0))
        if isinstance(count, bytes) and len(count) == 1 and count[0] < 0xFE:
            return await must_abort(wire, b"\x40" + mux(index, count[0] + 1), 0x0609_0011)
    raise NotHere("it has no object of " + ", ".join(f"{index:04X}h" for index in COUNTED))


async def empty_history(wire: NodeConnection) -> Finding:
    """CO-012: upload the first entry of an empty error history."""
    count = await wire.upload((0x1003, 0))
    if isinstance(count, SdoReply):
        raise NotHere(f"it has no error history, 1003h: {count}")
    if count != b"\0":
        raise NotHere(f"its error history holds {count[0]} errors")
    return await must_abort(wire, b"\x40" + mux(0x1003, 1), 0x0800_0024, 0x0800_0000)


async def short_request(wire: NodeConnection) -> Finding:
    """CO-026: send an upload request of 4 bytes. The node may ignore it or answer it."""
    wire.forget()
    await wire.send_sdo(b"\x40" + mux(0x1000))
    reply = await wire.reply()
    if reply.data and not reply.abort:
        return await verdict(wire, "", "takes it")
    return await verdict(wire, "", f"refuses it: {reply}" if reply.data else "ignores it")


async def extended_identifier(wire: NodeConnection) -> Finding:
    """CO-060: send an upload request with a 29-bit identifier of the same value. The node must not answer."""
    wire.forget()
    await wire.send(CanFrame(SDO_REQUEST + wire.node, (b"\x40" + mux(0x1000)).ljust(8, b"\0"), extended=True))
    reply = await wire.reply()
    return await verdict(wire, f"answers it: {reply}" if reply.data else "")


# -- block upload (7.2.4.3.13 to 15) ---------------------------------------------------------------------------------


async def _begin_block(wire: NodeConnection, key: Key, size: int, switch: int = 0) -> SdoReply:
    return await wire.ask(b"\xa4" + mux(*key) + bytes((size, switch)))


async def _must_have_blocks(wire: NodeConnection, key: Key) -> None:
    """Check that the node uploads `key` as a block, and then abort the transfer. Raises `NotHere` if the node does not."""
    reply = await _begin_block(wire, key, 127)
    if reply.specifier == 6:
        await wire.abandon(key)
        return
    if reply.data and not reply.abort:
        await wire.abandon(key)
        raise NotHere(f"it does no block upload of {shown(key)}, see CO-021: {reply}")
    raise NotHere(f"it has no block upload: {reply}")


async def _any_object(wire: NodeConnection) -> Key:
    return wire.long or (0x1000, 0)


async def no_switch_unasked(wire: NodeConnection) -> Finding:
    """CO-021: request a block upload without permission to switch to an ordinary upload. The node must answer with blocks or
    an abort.
    """
    key = await _any_object(wire)
    reply = await _begin_block(wire, key, 127, switch=0)
    if not reply.data:
        return await verdict(wire, "silence instead of a block upload, or an abort")
    if reply.abort:
        if lacks(reply):
            raise NotHere(f"it has no block upload: {reply}")
        return failed(str(reply))
    await wire.abandon(key)
    return await verdict(wire, "" if reply.specifier == 6 else f"an ordinary upload all the same: {reply}")


async def _block_size(wire: NodeConnection, size: int) -> Finding:
    key = await _any_object(wire)
    await _must_have_blocks(wire, key)
    return await must_abort(wire, b"\xa4" + mux(*key) + bytes((size, 0)), BLOCK_SIZE)


async def block_size_0(wire: NodeConnection) -> Finding:
    """CO-014: request an upload in blocks of 0 segments."""
    return await _block_size(wire, 0)


async def block_size_128(wire: NodeConnection) -> Finding:
    """CO-014: request an upload in blocks of 128 segments."""
    return await _block_size(wire, 128)


async def _block(wire: NodeConnection, size: int) -> list[bytes] | str:
    """Return the segments of one sub-block of at most `size` segments.

    If a reply is not the expected segment, return a description of it instead.
    """
    segments: list[bytes] = []
    while len(segments) < size:
        reply = await wire.reply()
        if not reply.data or reply.data[0] & 0x7F != len(segments) + 1:
            return f"{reply} instead of segment {len(segments) + 1}"
        segments.append(reply.data)
        if reply.data[0] & 0x80:
            break
    return segments


async def _block_upload(wire: NodeConnection, key: Key, size: int, *, lose: bool) -> tuple[bytes, str]:
    """Make a block upload up to its end frame; return the value, and a description of any error, empty if there was none.

    With `lose`, the first sub-block is acknowledged only up to its last but one segment. The client's confirmation of the
    end frame is left to the caller.
    """
    begun = await _begin_block(wire, key, size)
    if begun.specifier != 6:
        return b"", f"{begun} instead of a block upload"
    value, losing = b"", lose
    wire.forget()
    await wire.send_sdo(b"\xa3".ljust(8, b"\0"))
    for _ in range(MOST_BLOCKS):
        segments = await _block(wire, size)
        if isinstance(segments, str):
            return b"", segments
        got = segments[:-1] if losing and len(segments) > 1 else segments
        over = bool(segments[-1][0] & 0x80) and len(got) == len(segments)
        losing = losing and len(segments) < 2
        value += b"".join(segment[1:] for segment in got)
        await wire.send_sdo(bytes((0xA2, len(got), size)).ljust(8, b"\0"))
        if over:
            return await _block_end(wire, value, begun)
    await wire.abandon(key)
    return b"", "no end"


async def _block_end(wire: NodeConnection, value: bytes, begun: SdoReply) -> tuple[bytes, str]:
    end = await wire.reply()
    if end.specifier != 6 or end.data[0] & 3 != 1:
        return b"", f"{end} instead of the end"
    value = value[: len(value) - (end.data[0] >> 2 & 7)]
    crc = int.from_bytes(end.data[1:3], "little")
    if begun.data[0] & 4 and crc != crc16(value):
        return value, f"CRC {crc:04X} instead of {crc16(value):04X}"
    return value, ""


async def segment_lost(wire: NodeConnection) -> Finding:
    """CO-016: acknowledge a sub-block without its last segment, which the node must send again."""
    key = await long_object(wire)
    await _must_have_blocks(wire, key)
    usual = await present(wire, key)
    value, wrong = await _block_upload(wire, key, 4, lose=True)
    if wrong:
        await wire.abandon(key)
        return await verdict(wire, wrong)
    await wire.send_sdo(b"\xa1".ljust(8, b"\0"))
    return await verdict(
        wire, "" if value == usual else f"{value.hex(' ').upper()} instead of what an ordinary upload gives"
    )


async def right_after_the_end(wire: NodeConnection) -> Finding:
    """CO-019: send a request right after the end of a block upload."""
    key = await _any_object(wire)
    await _must_have_blocks(wire, key)
    _, wrong = await _block_upload(wire, key, 127, lose=False)
    if wrong:
        await wire.abandon(key)
        return await verdict(wire, wrong)
    wire.forget()
    await wire.send_sdo(b"\xa1".ljust(8, b"\0"))
    await wire.send_sdo((b"\x40" + mux(0x1000)).ljust(8, b"\0"), at_once=True)
    reply = await wire.reply()
    good = reply.specifier == 2 and reply.data[1:4] == mux(0x1000)
    return passed() if good else await verdict(wire, f"{reply} instead of 1000h")
