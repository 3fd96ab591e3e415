"""Cases of a serial line, RTU and ASCII: damaged frames, noise, pauses, and the traffic of other units. They send reads only.

SL is MODBUS over Serial Line V1.02. Where strict and tolerant receivers differ, both pass as long as they are
consistent.
"""

from __future__ import annotations

from fieldtwin.conformance.core.case import Finding, failed, passed
from fieldtwin.conformance.devices.device_case import NotHere, Unsaid
from fieldtwin.conformance.devices.modbus.checks import answers_good, silent_then_good
from fieldtwin.conformance.devices.modbus.connection import DeviceConnection
from fieldtwin.conformance.devices.modbus.frames import ascii_frame, framed
from fieldtwin.conformance.devices.modbus.learn import read_of
from fieldtwin.gateway.protocols.modbus.frames.ascii import lrc
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc

LONG_PAUSE_S = 0.1
"""A pause that ends any RTU frame at any baud rate from 1200 on."""


async def bad_check_sum(wire: DeviceConnection) -> Finding:
    """MB-001: send a request with a wrong check sum."""
    frame = bytearray(wire.frame(wire.good))
    frame[-1] ^= 0xFF
    frame[-2] ^= 0xFF
    await wire.send(bytes(frame), wire.good)
    return await silent_then_good(wire, await wire.hear())


async def half_then_whole(wire: DeviceConnection) -> Finding:
    """MB-004: send half a request, and after a pause a whole request."""
    frame = wire.frame(wire.good)
    await wire.send(frame[: len(frame) // 2], wire.good)
    await wire.pause(max(LONG_PAUSE_S, 2 * wire.pause_s))
    await wire.send(frame, wire.good)
    heard = await wire.hear()
    return passed() if answers_good(wire, heard, 1) else failed(f"{heard} instead of an answer to the complete one")


async def gap_inside(wire: DeviceConnection) -> Finding:
    """MB-005: send a frame with a pause of 2.5 characters or 2 ms inside."""
    frame = wire.frame(wire.good)
    await wire.send(frame[:4], wire.good)
    await wire.pause(max(6.5 * wire.char_s, 0.002))  # four characters are still in transmission
    await wire.send(frame[4:], wire.good, at_once=True)
    heard = await wire.hear()
    if answers_good(wire, heard, 1):
        return passed("takes it: tolerant")
    if not heard.nothing:
        return failed(f"{heard} instead of an answer or silence")
    after = await wire.still_good()
    return failed(f"the request afterwards: {after}") if after else passed("discards it: strict")


async def no_gap(wire: DeviceConnection) -> Finding:
    """MB-007: send two requests without a pause between them."""
    frame = wire.frame(wire.good)
    await wire.send(frame + frame, wire.good)
    heard = await wire.hear(2)
    if answers_good(wire, heard, 2):
        return passed("answers both: tolerant")
    if not heard.nothing:
        return failed(f"{heard} instead of two answers or none")
    after = await wire.still_good()
    return failed(f"the request afterwards: {after}") if after else passed("discards both: strict")


async def _among(wire: DeviceConnection, before: bytes, after: bytes) -> Finding:
    return await _goes_on(wire, before + wire.frame(wire.good) + after, may_discard=False)


async def _goes_on(wire: DeviceConnection, data: bytes, *, may_discard: bool) -> Finding:
    """Send a good request with noise around it, and a good request 0.1 s after the reply.

    `may_discard`: no answer to the first request is also correct. In RTU the noise and the frame are one frame, because no
    silence separates them, and its check sum is wrong (SL 2.5.1.1). With zeros after a frame the check sum is right again,
    and the length is wrong: exception 03 is correct as well.
    """
    await wire.send(data, wire.good)
    heard = await wire.hear()
    took = answers_good(wire, heard, 1)
    refused = len(heard.answers) == 1 and heard.answers[0].pdu == bytes((wire.good[0] | 0x80, 0x03)) and not heard.rest
    if not took and not (may_discard and (heard.nothing or refused)):
        return failed(f"{heard} instead of an answer" + (" or silence" if may_discard else ""))
    await wire.pause(LONG_PAUSE_S)
    again = await wire.still_good(at_once=True)
    if again:
        return failed(f"the request 0.1 s afterwards: {again}")
    said = "takes it: tolerant" if took else "refuses it: strict" if refused else "discards it: strict"
    return passed(said if may_discard else "")


async def _with_noise(wire: DeviceConnection, before: bytes, after: bytes) -> Finding:
    return await _goes_on(wire, before + wire.frame(wire.good) + after, may_discard=True)


async def leading_zero(wire: DeviceConnection) -> Finding:
    """MB-008: send 00 00 before the frame."""
    return await _with_noise(wire, b"\x00\x00", b"")


async def leading_ones(wire: DeviceConnection) -> Finding:
    """MB-008: send FF FF before the frame."""
    return await _with_noise(wire, b"\xff\xff", b"")


async def trailing_zeros(wire: DeviceConnection) -> Finding:
    """MB-009: send 00 00 after the frame."""
    return await _with_noise(wire, b"", b"\x00\x00")


async def broadcast_read(wire: DeviceConnection) -> Finding:
    """MB-027: send a read to unit 0, the broadcast address. No device may answer."""
    await wire.send(wire.frame(wire.good, 0), wire.good)
    return await silent_then_good(wire, await wire.hear())


async def _silent_neighbour(wire: DeviceConnection) -> int:
    """Return an unused unit ID. Raises `Unsaid` if a device answers to each of the unit IDs that were tried."""
    for unit in _neighbours(wire):
        if (await wire.ask(wire.good, unit, due=False)).nothing:
            await wire.settle()
            return unit
    raise Unsaid("it answers to every other unit ID that was tried: see MB-029")


def _neighbours(wire: DeviceConnection) -> list[int]:
    return [unit for unit in (wire.unit % 247 + 1, 247, 200, 113) if unit != wire.unit][:3]


async def other_unit(wire: DeviceConnection) -> Finding:
    """MB-029: send requests to other units. If three units give the same answer, one device answers to all unit IDs."""
    said = []
    for unit in _neighbours(wire):
        heard = await wire.ask(wire.good, unit, due=False)
        if heard.nothing:
            after = await wire.still_good()
            return failed(f"the request afterwards: {after}") if after else passed(f"silence for unit {unit}")
        said.append((unit, heard))
    pdus = {heard.first.pdu if heard.first else heard.rest for _, heard in said}
    units = ", ".join(str(unit) for unit, _ in said)
    if len(pdus) == 1:
        return failed(f"units {units} give the same answer: {said[0][1]}")
    raise Unsaid(f"units {units} answer, each differently: there are other units on this line")


async def neighbours_talk(wire: DeviceConnection) -> Finding:
    """MB-030: send another unit's request and its response, then a request to this unit."""
    other = await _silent_neighbour(wire)
    request = read_of(0x03, 0, 2)
    response = b"\x03\x04\x11\x22\x33\x44"
    await wire.send(wire.frame(request, other), request)
    await wire.pause(LONG_PAUSE_S)
    await wire.send(wire.frame(response, other), request)
    await wire.pause(LONG_PAUSE_S)
    await wire.send(wire.frame(wire.good), wire.good)
    heard = await wire.hear()
    return passed() if answers_good(wire, heard, 1) else failed(f"{heard} instead of an answer to ours alone")


async def neighbour_silent(wire: DeviceConnection) -> Finding:
    """MB-031: send a request that another unit does not answer, then one to this unit."""
    other = await _silent_neighbour(wire)
    request = read_of(0x03, 0, 2)
    await wire.send(wire.frame(request, other), request)
    await wire.pause(LONG_PAUSE_S)
    await wire.send(wire.frame(wire.good), wire.good)
    heard = await wire.hear()
    return passed() if answers_good(wire, heard, 1) else failed(f"{heard} instead of an answer to ours alone")


async def stranger_function(wire: DeviceConnection) -> Finding:
    """MB-032: send an unknown function code to another unit."""
    other = await _silent_neighbour(wire)
    pdu = b"\x64\x00\x01"
    await wire.send(wire.frame(pdu, other), pdu)
    heard = await wire.hear()
    if not heard.nothing:
        return failed(f"{heard} instead of silence")
    after = await wire.still_good(at_once=True)
    return failed(f"the request right afterwards: {after}") if after else passed()


async def wrong_baud_rate(wire: DeviceConnection) -> Finding:
    """MB-068: send the bytes that a wrong baud rate makes of a request."""
    await wire.send(bytes.fromhex("80 00 F8 00 78 80 E6 FE 00 80 F8 66 06 FE"), b"\x80")
    await wire.pause(LONG_PAUSE_S)
    return await silent_then_good(wire, await wire.hear())


async def two_clients(wire: DeviceConnection) -> Finding:
    """MB-069: send two overlapping requests, combined bit by bit."""
    one, other = wire.frame(wire.good), framed("rtu", wire.unit, read_of(0x04, 0x1234, 9))
    if wire.framing == "ascii":
        raise NotHere("this test case runs on RTU")
    await wire.send(bytes(a & b for a, b in zip(one, other, strict=False)), b"\x80")
    await wire.pause(LONG_PAUSE_S)
    return await silent_then_good(wire, await wire.hear())


# -- ASCII (SL 2.5.2) --------------------------------------------------------------------------------------------------


async def bad_lrc(wire: DeviceConnection) -> Finding:
    """MB-070: send a request with a wrong check sum (LRC)."""
    body = bytes((wire.unit,)) + wire.good
    await wire.send(ascii_frame(body, lrc(body) ^ 0xFF), wire.good)
    return await silent_then_good(wire, await wire.hear())


async def second_colon(wire: DeviceConnection) -> Finding:
    """MB-070: send half a frame, then a whole frame. The colon begins a new frame."""
    frame = wire.frame(wire.good)
    await wire.send(frame[:7] + frame, wire.good)
    heard = await wire.hear()
    return passed() if answers_good(wire, heard, 1) else failed(f"{heard} instead of an answer to the second")


async def gap_over_a_second(wire: DeviceConnection) -> Finding:
    """MB-070: send a frame with a pause of 1.5 s between two characters."""
    frame = wire.frame(wire.good)
    await wire.send(frame[:7], wire.good)
    await wire.pause(1.5)
    await wire.send(frame[7:], wire.good, at_once=True)
    return await silent_then_good(wire, await wire.hear())


async def gap_under_a_second(wire: DeviceConnection) -> Finding:
    """MB-070: send a frame with a pause of half a second between two characters."""
    frame = wire.frame(wire.good)
    await wire.send(frame[:7], wire.good)
    await wire.pause(0.5)
    await wire.send(frame[7:], wire.good, at_once=True)
    heard = await wire.hear()
    return passed() if answers_good(wire, heard, 1) else failed(f"{heard} instead of an answer")


async def noise_before_colon(wire: DeviceConnection) -> Finding:
    """MB-070: send noise before the colon of a frame."""
    return await _among(wire, b"\x00\xffQ1", b"")


async def no_character(wire: DeviceConnection) -> Finding:
    """MB-070: send a character other than 0 to F inside the frame."""
    frame = bytearray(wire.frame(wire.good))
    frame[5:6] = b"G"
    await wire.send(bytes(frame), wire.good)
    return await silent_then_good(wire, await wire.hear())


def longest(wire: DeviceConnection) -> bytes:
    """Return the PDU of the longest FC 08 request, which the device echoes (SL 2.5.1: a frame of 256 bytes)."""
    return b"\x08\x00\x00" + b"\x5a" * 250


async def frame_of_256(wire: DeviceConnection) -> Finding:
    """MB-050: send the longest permitted frame; FC 08 must echo it."""
    short = await wire.ask(b"\x08\x00\x00\x5a\x5a")
    if short.first is None or short.first.pdu != b"\x08\x00\x00\x5a\x5a":
        raise NotHere(f"it has no echo (function 08): {short}")
    heard = await wire.ask(longest(wire))
    whole = heard.first is not None and heard.first.pdu == longest(wire)
    return passed() if whole else failed(f"{heard} instead of the same bytes")


async def frame_of_257(wire: DeviceConnection) -> Finding:
    """MB-050: send a frame of 257 bytes, which is one byte too long."""
    body = bytes((wire.unit,)) + longest(wire) + b"\x5a"
    await wire.send(with_crc(body), longest(wire))
    await wire.pause(LONG_PAUSE_S)
    heard = await wire.hear()
    if not heard.nothing:
        return failed(f"{heard} instead of silence")
    after = await wire.still_good()
    return failed(f"the request afterwards: {after}") if after else passed()
