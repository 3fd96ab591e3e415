"""Intentionally wrong Modbus devices: wrong in one answer, or careless about all properties of a frame."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from devices_in_memory import make_unit

from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.errors import ConnectionLost
from fieldtwin.gateway.protocols.modbus.frames.ascii import lrc
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc

Twist = Callable[[ModbusUnit, bytes, bytes | None], bytes | None]
"""Map the unit, the request and the correct answer to the answer sent."""
Serve = Callable[[ByteConnection], Awaitable[None]]


def twisted(twist: Twist) -> ModbusUnit:
    """The device of the tests with a replaced answer function."""
    unit = make_unit()
    right = unit.respond
    unit.respond = lambda pdu, now_ns: twist(unit, pdu, right(pdu, now_ns))  # type: ignore[method-assign]
    return unit


def instead(function: int, answer: bytes | None, *, where: Callable[[bytes], bool] = lambda pdu: True) -> Twist:
    """Replace the answer to requests of `function` that meet the condition."""
    return lambda unit, pdu, right: answer if pdu[0] == function and where(pdu) else right


def swallow_after(function: int) -> Twist:
    """Do not answer the request that follows one of `function`."""
    seen: list[int] = []

    def twist(unit: ModbusUnit, pdu: bytes, right: bytes | None) -> bytes | None:
        swallowed = bool(seen) and seen[-1] == function
        seen.append(pdu[0])
        return None if swallowed else right

    return twist


def alternating(function: int, answers: list[bytes | None]) -> Twist:
    """Return these answers to requests of `function`, in order."""
    turn = [0]

    def twist(unit: ModbusUnit, pdu: bytes, right: bytes | None) -> bytes | None:
        if pdu[0] != function:
            return right
        turn[0] += 1
        return answers[(turn[0] - 1) % len(answers)]

    return twist


def written(table: str, value: Callable[[bytes], int], function: int, where: Callable[[bytes], bool]) -> Twist:
    """Write the first cell, whatever the answer is."""

    def twist(unit: ModbusUnit, pdu: bytes, right: bytes | None) -> bytes | None:
        if pdu[0] == function and where(pdu):
            unit.bank.poke(table, int.from_bytes(pdu[1:3]), value(pdu))  # type: ignore[attr-defined]
        return right

    return twist


def old_value_of_fc23(unit: ModbusUnit, pdu: bytes, right: bytes | None) -> bytes | None:
    """Read before writing: the correct answer with its bit restored."""
    return right[:3] + bytes((right[3] ^ 1,)) if pdu[0] == 0x17 and right and len(right) == 4 else right


# -- careless about frames --------------------------------------------------------------------------------------------


def _answer(unit: ModbusUnit, pdu: bytes) -> bytes:
    return unit.respond(pdu, 0) or bytes((pdu[0] | 0x80, 0x04))


async def careless_rtu(end: ByteConnection) -> None:
    """Treat any eight bytes as a request, for any unit and with any CRC; half a second ends a frame."""
    unit, data = make_unit(), b""
    while True:
        chunk = await end.read_within(0.5)
        data = data + chunk if chunk else b""
        while len(data) >= 8:
            frame, data = data[:8], data[8:]
            await end.write(with_crc(frame[:1] + _answer(unit, frame[1:6])))


async def careless_ascii(end: ByteConnection) -> None:
    """Accept the text between a colon and CR LF; check neither LRC nor unit, and wait without limit."""
    unit, data = make_unit(), b""
    while True:
        data += await end.read()
        while b"\r\n" in data:
            line, data = data.split(b"\r\n", 1)
            digits = line[1:].replace(b"G", b"0")
            try:
                body = bytes.fromhex(digits.decode("latin-1"))[:-1]
            except ValueError:
                continue
            if len(body) < 2:
                continue
            reply = body[:1] + _answer(unit, body[1:])
            await end.write(b":" + (reply + bytes((lrc(reply),))).hex().upper().encode() + b"\r\n")


async def careless_tcp(end: ByteConnection) -> None:
    """Treat each segment as an ADU, ignore the header, and answer as unit 1, with id 1 if there was none."""
    unit = make_unit()
    try:
        while True:
            adu = await end.read()
            if len(adu) < 8:
                continue
            reply = _answer(unit, adu[7:12])
            transaction = adu[:2] if adu[:2] != b"\0\0" else b"\0\x01"
            await end.write(transaction + b"\0\0" + (len(reply) + 1).to_bytes(2) + b"\x01" + reply)
    except ConnectionLost:
        return
