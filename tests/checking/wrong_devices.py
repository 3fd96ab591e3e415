"""Modbus devices that are wrong on purpose: in one answer, or careless about all that a frame should be."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from devices_in_memory import make_unit

from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.errors import ConnectionLost
from fieldtwin.gateway.protocols.modbus.ascii import lrc
from fieldtwin.gateway.protocols.modbus.crc import with_crc

Twist = Callable[[ModbusUnit, bytes, bytes | None], bytes | None]
"""The unit, the request and the right answer -> what is answered."""
Serve = Callable[[ByteConnection], Awaitable[None]]


def twisted(twist: Twist) -> ModbusUnit:
    """The device of the tests with another tongue."""
    unit = make_unit()
    right = unit.respond
    unit.respond = lambda pdu, now_ns: twist(unit, pdu, right(pdu, now_ns))  # type: ignore[method-assign]
    return unit


def instead(function: int, answer: bytes | None, *, where: Callable[[bytes], bool] = lambda pdu: True) -> Twist:
    """Another answer to requests of `function` that are so."""
    return lambda unit, pdu, right: answer if pdu[0] == function and where(pdu) else right


def swallow_after(function: int) -> Twist:
    """Nothing to the request behind one of `function`."""
    seen: list[int] = []

    def twist(unit: ModbusUnit, pdu: bytes, right: bytes | None) -> bytes | None:
        swallowed = bool(seen) and seen[-1] == function
        seen.append(pdu[0])
        return None if swallowed else right

    return twist


def alternating(function: int, answers: list[bytes | None]) -> Twist:
    """The answers to requests of `function`, in turn."""
    turn = [0]

    def twist(unit: ModbusUnit, pdu: bytes, right: bytes | None) -> bytes | None:
        if pdu[0] != function:
            return right
        turn[0] += 1
        return answers[(turn[0] - 1) % len(answers)]

    return twist


def written(table: str, value: Callable[[bytes], int], function: int, where: Callable[[bytes], bool]) -> Twist:
    """Whatever is answered, the first cell is written."""

    def twist(unit: ModbusUnit, pdu: bytes, right: bytes | None) -> bytes | None:
        if pdu[0] == function and where(pdu):
            unit.bank.poke(table, int.from_bytes(pdu[1:3]), value(pdu))  # type: ignore[attr-defined]
        return right

    return twist


def old_value_of_fc23(unit: ModbusUnit, pdu: bytes, right: bytes | None) -> bytes | None:
    """Reads before it writes: the right answer with its bit turned back."""
    return right[:3] + bytes((right[3] ^ 1,)) if pdu[0] == 0x17 and right and len(right) == 4 else right


# -- careless about frames --------------------------------------------------------------------------------------------


def _answer(unit: ModbusUnit, pdu: bytes) -> bytes:
    return unit.respond(pdu, 0) or bytes((pdu[0] | 0x80, 0x04))


async def careless_rtu(end: ByteConnection) -> None:
    """Takes eight bytes for a request, whoever it is for and whatever its CRC is; half a second ends a frame."""
    unit, data = make_unit(), b""
    while True:
        chunk = await end.read_within(0.5)
        data = data + chunk if chunk else b""
        while len(data) >= 8:
            frame, data = data[:8], data[8:]
            await end.write(with_crc(frame[:1] + _answer(unit, frame[1:6])))


async def careless_ascii(end: ByteConnection) -> None:
    """Takes what is between a colon and CR LF; no LRC, no other unit, no end of patience."""
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
    """Takes each segment for an ADU, believes no header, answers as unit 1 with id 1 if there was none."""
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
