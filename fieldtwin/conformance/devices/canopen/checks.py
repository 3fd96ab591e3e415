"""Checks that many CANopen cases share: an expected abort, the recovery afterwards, and suitable objects."""

from __future__ import annotations

from fieldtwin.conformance.core.case import Finding, failed, passed
from fieldtwin.conformance.devices.canopen.connection import Key, NodeConnection, SdoReply, mux, shown
from fieldtwin.conformance.devices.device_case import NotHere
from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import UNKNOWN_SPECIFIER


def aborted(reply: SdoReply, *codes: int) -> str:
    """Return an empty string if `reply` is an abort with one of `codes`, else a description of the difference."""
    if reply.abort and reply.abort in codes:
        return ""
    return f"{reply} instead of abort {' or '.join(f'{code:08X}' for code in codes)}"


async def verdict(wire: NodeConnection, wrong: str, good: str = "") -> Finding:
    """Return FAILED if `wrong` describes an error or the node does not recover afterwards; else PASSED, with `good` as the
    reason.
    """
    if wrong:
        return failed(wrong)
    after = await wire.still_good()
    return failed(f"afterwards: {after}") if after else passed(good)


async def must_abort(wire: NodeConnection, request: bytes, *codes: int) -> Finding:
    """Send an SDO request that has to be aborted with one of `codes`; then the node must continue to answer."""
    reply = await wire.ask(request)
    if reply.data and not reply.abort:
        await wire.abandon((0x1000, 0))
    return await verdict(wire, aborted(reply, *codes), str(reply) if reply.abort else "")


async def long_object(wire: NodeConnection) -> Key:
    """Return an object whose upload needs at least two segments. Raises `NotHere` if the check has found none."""
    if wire.long is None:
        raise NotHere("no object of 8 to 5,000 bytes was found: 1008h, 1009h, 100Ah, and those of the EDS")
    return wire.long


async def begin_upload(wire: NodeConnection, key: Key) -> None:
    """Begin an upload in segments. Raises `NotHere` if the node does not answer with segments."""
    reply = await wire.ask(b"\x40" + mux(*key))
    if reply.specifier != 2 or reply.data[0] & 2:
        raise NotHere(f"{shown(key)} is not uploaded in segments: {reply}")


async def present(wire: NodeConnection, key: Key) -> bytes:
    """Return the object's value. Raises `NotHere` if the object cannot be read."""
    value = await wire.upload(key)
    if isinstance(value, SdoReply):
        raise NotHere(f"{shown(key)}: {value}")
    return value


def lacks(reply: SdoReply) -> bool:
    """Return whether an abort means that the node has no such service."""
    return reply.abort in (UNKNOWN_SPECIFIER, 0x0601_0000, 0x0800_0000)
